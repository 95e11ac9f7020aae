"""The mistakes: a text of a file, what it becomes, and the tests that must then fail."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutation:
    """`old`, found once in `file`, becomes `new`; one of `tests`, paths from the root, must fail then."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


Change = tuple[str, str, str]  # name, old, new


def _of(file: str, tests: str, *changes: Change) -> Iterator[Mutation]:
    """The mutations of one file, found by the same tests (separated by blanks)."""
    for name, old, new in changes:
        yield Mutation(name=name, file=file, old=old, new=new, tests=tuple(tests.split()))


BY_HAND = (
    *_of(
        "automodel/runtime/safety.py",
        "tests/runtime/test_by_hand.py",
        ("let-go-is-forgotten", 'return "the person who drove let go" if', "return None if"),
        ("by-hand-without-health", "since_ns = self._drivable_since_ns if", "since_ns = 0 if"),
        ("by-hand-without-frames", "unwell = unwell if inputs.by_hand", "unwell = None if inputs.by_hand"),
        ("the-lane-never-counts", "else unwell or lane_fault", "else unwell"),
    ),
    *_of(
        "automodel/control/manual.py",
        "tests/control/test_manual.py",
        ("stale-throttle", "if t_ns - wanted.t_ns >= FRESH_NS", "if False"),
        ("no-ramp-by-hand", "before_mps + self._accel_mps2 * dt_s", "9.0"),
    ),
    *_of(
        "automodel/manual/operator.py",
        "tests/manual/test_device.py",
        ("pressed-from-the-start", "self._pressed = True  # until", "self._pressed = False  # until"),
        ("gone-is-no-stop", "        if self._read() is None:\n", "        if False:\n"),
    ),
    *_of(
        "automodel/manual/dead_man.py",
        "tests/manual/test_dead_man.py",
        ("silence-is-fine", "now_ns - self._heard_ns < HOLD_TIMEOUT_S * 1e9", "True"),
        (
            "hold-arms",
            "        if self.held:\n            self._heard_ns",
            "        if True:\n            self._heard_ns",
        ),
        ("let-go-unheard", 'return f"{self._place}\'s button was released" if was_held else None', "return None"),
        ("silence-for-5-s", "HOLD_TIMEOUT_S = 0.5 ", "HOLD_TIMEOUT_S = 5.0 "),
        ("arms-again-and-again", "asked, self._arm = self._arm, False", "asked = self._arm"),
    ),
)
SAFETY = (
    *_of(
        "automodel/runtime/safety.py",
        "tests/runtime/test_safety.py",
        ("frame-time-unchecked", "if self._frame_t_ns is not None and t_ns <= self._frame_t_ns:", "if False:"),
        ("frame-from-the-future", "if t_ns - now_ns > FUTURE_S * NS_PER_S:", "if False:"),
        ("old-frames-are-fresh", "if age_ns >= self._frame_timeout_ns:", "if age_ns >= 4 * self._frame_timeout_ns:"),
        ("held-for-ever", "if held_ns >= self._hold_ns:", "if False:"),
        ("held-again-and-again", "if len(self._held_ns) >= self._holds_max:", "if False:"),
        ("holds-forgotten-early", "now_ns - self._held_ns[0] >= self._holds_window_ns", "now_ns > self._held_ns[0]"),
        ("restart-ignored", "if self._boot_id is not None and state.boot_id != self._boot_id:", "if False:"),
        ("link-down-ignored", "        if not link_up:", "        if False:"),
        ("silence-ignored", "if abs(now_ns - state.t_ns) > LINK_SILENCE_S * NS_PER_S:", "if False:"),
        ("clock-back-ignored", "if stood_ns < 0:", "if False:"),
        ("stall-unnoticed", "if stood_ns > self._validity_ns:", "if False:"),
        ("stall-always-near", "near = inputs.speed_mps * stood_ns <= self._blind_m * NS_PER_S", "near = True"),
        ("stall-never-too-long", "if stood_ns >= STALL_S * NS_PER_S or not near:", "if not near:"),
        ("broken-ignored", "elif broken is not None:", "elif False:"),
        ("rearmed-at-once", "if reason is None and healthy_ns >= self._rearm_ns:", "if reason is None:"),
        ("arms-by-itself", "if inputs.arm or self._auto_arm:", "if True:"),
        ("auto-arm-again", "            self._auto_arm = False\n", ""),
        ("arming-without-end", "now_ns - self._since_ns >= ARM_TIMEOUT_S * NS_PER_S", "False"),
        ("lost-lane-ignored", "if self._lane_fault is None and seen.status is LaneStatus.LOST:", "if False:"),
        ("faults-ignored", "if self._frame_fault is None and inputs.faults:", "if False:"),
        ("faults-without-frame-ignored", "        elif inputs.faults:\n", "        elif False:\n"),
        (
            "passes-when-stopped",
            "action, arm, disarm = Action.NEUTRAL, False",
            "action, arm, disarm = Action.PASS, False",
        ),
        ("never-disarms", "disarm = due and (armed or self._must_disarm)", "disarm = False"),
        ("still-armed-ignored", "SafetyMode.STOPPED) and state.armed:", "SafetyMode.STOPPED) and False:"),
        ("rolls-out-while-it-stands", "        if self._rolled_out:\n            return False\n", ""),
        (
            "rolled-out-before-the-next-stop",
            "        self._since_ns = now_ns\n        self._rolled_out = False\n",
            "        self._since_ns = now_ns\n",
        ),
        ("stands-by-a-link-that-is-down", "heard = inputs.state if inputs.link_up else None", "heard = inputs.state"),
        ("rolls-out-without-end", "0 <= rolled_ns < ROLL_OUT_S * NS_PER_S", "0 <= rolled_ns"),
        ("rolls-out-by-a-clock-set-back", "0 <= rolled_ns < ROLL", "rolled_ns < ROLL"),
        ("driver-ignored", "if state.driver_override:", "if False:"),
        ("own-disarming-ignored", 'return None, "the vehicle has disarmed itself"', "return None, None"),
        ("drives-on-while-unwell", "if unwell is None and inputs.seen is not None:", "if inputs.seen is not None:"),
    ),
    *_of(
        "automodel/runtime/runner.py",
        "tests/runtime/test_runner.py tests/runtime/test_runner_faults.py",
        ("no-neutral-at-the-end", "            leaving.callback(self._park)\n", ""),
        ("wrong-time-looked-at", "if self._safety.frame_time_fault(frame.t_ns, now_ns) is not None:", "if False:"),
        (
            "hold-keeps-the-throttle",
            "command = self._standstill(self._on_wire.steering_rad, now_ns)",
            "command = self._on_wire",
        ),
        ("link-not-woken", "wait_ns = min(wait_ns, wake_ns - now_ns)", "pass"),
        ("neutral-not-sent", "elif decision.action is Action.NEUTRAL:", "elif False:"),
        ("exceptions-fall-through", "except Exception as error:", "except ArithmeticError as error:"),
        ("states-not-finite", "faults = state_faults(said)", "faults: tuple[str, ...] = ()"),
        ("armed-at-the-end", "self._link.disarm(now_ns)\n        self._run_log", "self._run_log"),
        ("never-arms-again", "elif decision.disarm:", "elif False:"),
        ("stop-of-a-person-ignored", "stop=stop,", "stop=None,"),
    ),
    *_of(
        "automodel/runtime/loop.py",
        "tests/runtime/test_loop.py",
        ("late-frames-live-long", "valid_until_ns = min(frame.t_ns, t_ns) + self", "valid_until_ns = t_ns + 2 * self"),
        ("life-stretched", "min(command.valid_until_ns, valid_until_ns)", "command.valid_until_ns"),
        ("limits-skipped", "command = limited.command", "command = wanted"),
        ("wanted-not-finite", "if not _is_finite(wanted):", "if False:"),
        ("limited-not-finite", "if not _is_finite(command):", "if False:"),
        ("estimate-not-finite", "return lost, wrong + faults", "return estimate, wrong"),
        ("motion-not-finite", "        faults = motion_faults(motion)\n", "        faults: tuple[str, ...] = ()\n"),
        ("misfit-looked-at", "if misfit is not None:", "if False:"),
        ("overruled-forgotten", "self._limits.reset(sent)", "self._limits.reset()"),
        ("never-looks-again", "        self._look_again(estimate, motion, state)\n", ""),
        (
            "looks-again-while-armed",
            "if state is None or state.armed or not stands:",
            "if state is None or not stands:",
        ),
        ("looks-again-while-it-rolls", "state.armed or not stands:", "state.armed:"),
        ("wrong-eye-of-a-pair", "index=frame.index, image=frame.left)", "index=frame.index, image=frame.right)"),
    ),
    *_of(
        "automodel/runtime/standstill.py",
        "tests/runtime/test_safety.py",
        ("stands-by-a-dead-odometry", "        if driven and stands:\n            self._counts = False\n", ""),
        ("stands-between-two-ticks", "STAND_GAPS = 3.0 ", "STAND_GAPS = 1.0 "),
        ("stands-at-once", "STAND_S = 0.2 ", "STAND_S = 0.02 "),
        (
            "no-odometry-stands",
            "            self._counts = False\n            return False\n",
            "            return self._counts\n",
        ),
    ),
    *_of(
        "automodel/runtime/input_checks.py",
        "tests/runtime/test_input_checks.py",
        ("blank-images-pass", "FLAT_LEVELS = 6 ", "FLAT_LEVELS = 0 "),
        ("repeated-images-pass", "not self._noiseless and same_image(before, image)", "False"),
        ("other-sizes-pass", "if (height, width) == self._shape:", "if True:"),
        ("lane-jumps-pass", "if abs(sideways_m) > most_m:", "if False:"),
        ("lane-turns-pass", "if abs(turn_rad) > most_rad:", "if False:"),
        ("uncertain-for-ever", "return None if bridged else text", "return None"),
        ("armed-in-any-lane", "return text if pose.offset_bound_m >= 0.5 * pose.width_m else None", "return None"),
        ("bound-never-held", "(jump, width, uncertain, turns)", "(jump, width, turns)"),
        ("any-width-passes", "vehicle.width_m <= pose.width_m <= WIDEST_CARS * vehicle.width_m", "pose.width_m > 0"),
        ("pairs-of-any-times-pass", "if abs(right_late_ns) <= self._tolerance_ns:", "if True:"),
        (
            "pairs-have-no-tolerance",
            "math.inf if right is None else right.tolerance_s(car.camera.rate_hz)",
            "math.inf",
        ),
        ("stuck-servo-passes", "LASTING_S = 0.25 ", "LASTING_S = 25.0 "),
    ),
    *_of(
        "automodel/runtime/supervised_link.py",
        "tests/runtime/test_supervised_link.py",
        ("sends-before-hello", "return self._up and self._hello", "return self._up"),
    ),
)

LIMITS = (
    *_of(
        "automodel/control/limits.py",
        "tests/control/test_limits.py",
        ("speed-unlimited", "_clipped(command.speed_mps, safety.speed_max_mps, SPEED, reasons)", "command.speed_mps"),
        ("lock-unlimited", "_clipped(requested, safety.steering_max_rad, STEERING, reasons)", "requested"),
        ("rate-unlimited", "if abs(steering - start) > safety.steering_rate_max_radps * dt:", "if False:"),
        ("bend-unlimited", "_clipped(steering, steepest, LATERAL_ACCEL, reasons)", "steering"),
        ("jerk-unlimited", "if abs(change) * squared > safety.lateral_jerk_max_mps3 * dt:", "if False:"),
        ("not-finite-passes", "if not all(map(math.isfinite, numbers)) or (", "if False and ("),
        ("speed-before-forgotten", "max(abs(speed), abs(before.speed_mps), abs(measured or 0.0))", "abs(speed)"),
        ("too-fast-in-the-bend", "if abs(speed) > speed_max:", "if False:"),
    ),
    *_of(
        "automodel/config/__init__.py",
        "tests/runtime/test_freshness.py",
        ("commands-live-1-s", "command_validity_s: float = 0.10 ", "command_validity_s: float = 1.0 "),
        ("frames-live-1-s", "frame_timeout_s: float = 0.06 ", "frame_timeout_s: float = 1.0 "),
        ("held-for-3-s", "hold_s: float = 0.3 ", "hold_s: float = 3.0 "),
    ),
    *_of(
        "automodel/runtime/safety.py",
        "tests/runtime/test_freshness.py",
        ("silent-for-300-ms", "LINK_SILENCE_S = 0.1 ", "LINK_SILENCE_S = 0.3 "),
        ("slow-cycles", "CYCLE_S = 0.02 ", "CYCLE_S = 0.2 "),
        ("rolls-out-for-20-s", "ROLL_OUT_S = 2.0 ", "ROLL_OUT_S = 20.0 "),
    ),
    *_of(
        "automodel/config/ranges.py",
        "tests/config",
        ("hold-without-bound", '"safety.hold_s": (0.01, 2.0)', '"safety.hold_s": (0.01, 200.0)'),
        (
            "validity-without-bound",
            '"safety.command_validity_s": (0.01, 0.5)',
            '"safety.command_validity_s": (0.01, 50)',
        ),
        ("no-upper-ends", "if size == 0 or least <= size <= most:", "if size == 0 or least <= size:"),
    ),
)

WIRE = (
    *_of(
        "firmware_link/arduino.py",
        "tests/firmware_link/test_arduino_link.py tests/firmware_link/test_link_contract.py",
        ("stale-commands-sent", "            and now_ns <= command.valid_until_ns\n", ""),
        ("deadline-of-1-s", "_VALID_NS = 100 * _MS", "_VALID_NS = 1000 * _MS"),
        ("fresh-while-disarmed", "            session.wants_armed\n            and now_ns", "            now_ns"),
        ("repeating-board-heard", "status.time_us == session.status.time_us", "False"),
        ("silent-board-ignored", "if now_ns - session.status_ns > _SILENT_NS:", "if False:"),
        ("boot-id-ignored", "session.hello.boot_id != hello.boot_id:", "False:"),
        ("any-firmware", "if (hello.table_hash, hello.version) != (", "if (0, 0) == ("),
        ("no-limits-ignored", "if status.flags & StatusFlag.NO_LIMITS:", "if False:"),
        ("steering-not-finite", "            and math.isfinite(command.steering_rad)\n", ""),
        ("throttle-not-finite", "            and math.isfinite(command.speed_mps)\n", ""),
        (
            "armed-at-close",
            "                self._write(messages.Disarm())\n        self._session = None",
            "                pass\n        self._session = None",
        ),
    ),
    *_of(
        "firmware_link/timing.py",
        "tests/firmware_link/test_link_timing.py",
        ("board-clock-ahead", "min(before, self._least_ns)", "max(before, self._least_ns)"),
        ("board-time-back", "if step_us >= _WRAP_US // 2:", "if False:"),
    ),
    *_of(
        "firmware_link/framing.py",
        "tests/firmware_link/test_framing.py tests/firmware_link/test_messages.py",
        ("check-unread", "if received != known.check.of(stuffed):", "if False:"),
        ("check-without-seed", "zlib.crc32(stuffed, seed)", "zlib.crc32(stuffed)"),
    ),
    *_of(
        "firmware_link/can_link.py",
        "tests/firmware_link/test_can_link.py",
        ("can-commands-live-1-s", "VALID_NS = 100 * _MS", "VALID_NS = 1000 * _MS"),
        ("torque-ignored", 'abs(values.get("driver_torque_nm", 0.0)) > config.override_torque_nm', "False"),
        ("brake-ignored", '            or values.get("brake", 0.0) != 0\n', ""),
        ("gear-ignored", '(gear is not None and gear != "D")', "False"),
        ("can-faults-ignored", "if session.snapshot.faults:\n            return", "if False:\n            return"),
        ("bus-errors-ignored", "if len(session.errors_ns) >= ERRORS_MAX:", "if False:"),
        ("disengaged-ignored", "elif session.armed and engaged == 0:", "elif False:"),
        ("can-commands-wait-a-frame", "            self._keep_pace(session, now_ns)\n", ""),
        ("can-messages-as-uneven-as-steps", "SPREADS = 2.0", "SPREADS = 0.0"),
        ("can-stale-command-first", "(0 if fresh else round(OVERDUE_SHARE * writer.period_ns))", "0"),
        ("never-engaged-ignored", "if not session.armed and now_ns - session.arm_ns > ARM_NS:", "if False:"),
    ),
    *_of(
        "firmware_link/can_link.py",
        "tests/firmware_link/test_can_link.py",
        (
            "accelerator-ignored",
            '            or values.get("accelerator", 0.0) > config.override_accelerator\n',
            "",
        ),
        ("bus-off-ignored", "if BusTrouble.OFF in received.troubles:", "if False:"),
        ("error-passive-ignored", "[now_ns] * (ERRORS_MAX if trouble is BusTrouble.PASSIVE else 1)", "[now_ns]"),
        ("errors-kept", "while session.errors_ns and now_ns - session.errors_ns[0] > ERRORS_NS:", "while False:"),
        ("second-sender-ignored", "session.intruded_ns = frame.t_ns", "pass"),
        ("override-between-cycles-ignored", "session.overridden_ns = frame.t_ns  # also", "pass  # also"),
        (
            "arms-whatever-is-wrong",
            "            session.latched.append(fault)\n            return\n        session.wants",
            "            session.latched.append(fault)\n        session.wants",
        ),
        ("can-list-unread", "self._port = WhitelistedPort(port, allowed)", "self._port = port  # type: ignore"),
        (
            "measured-angle-not-followed",
            "following_rad = session.steering_rad if measured_rad is None else measured_rad",
            "following_rad = session.steering_rad",
        ),
        ("enabled-while-disarmed", "if not session.wants_armed or measured_rad is None", "if measured_rad is None"),
        ("can-not-latched", "session.wants_armed = session.armed = False", "session.armed = False"),
        ("can-stale-commands", "if session.ready and now_ns <= command.valid_until_ns:", "if session.ready:"),
        (
            "can-sends-before-hello",
            "        if not session.ready:\n            return None\n        self._judge",
            "        self._judge",
        ),
        ("no-command-for-ever", "if session.armed and now_ns > until_ns and", "if False and"),
        ("can-state-of-a-bus-at-fault", "if self._bus_fault(session, now_ns) is None:", "if True:"),
        ("heartbeat-missing-is-a-restart", 'values.get("boot_id", session.boot_id)', 'values.get("boot_id")'),
        ("acceleration-jumps", "limited_acceleration_mps2(wanted_mps2, session.accel_mps2, dt_s)", "wanted_mps2"),
    ),
    *_of(
        "firmware_link/can_receiver.py",
        "tests/firmware_link/test_can_receiver.py tests/fuzz/test_can_frames.py",
        ("can-length-unread", "if len(data) != self.length:", "if False:"),
        (
            "can-checksum-unread",
            "if self._checksum is not None and self.checksum_in(data) != self.checksum_for(data):",
            "if False:",
        ),
        ("can-counter-unread", "if verdict is Verdict.GOOD and not self._counted(counter):", "if False:"),
        ("can-any-counter-after-damage", "min(self._unread, BAD_MAX)", "100 * self._unread"),
        (
            "can-any-range",
            "if part.value in values and not part.minimum <= values[part.value] <= part.maximum:",
            "if False:",
        ),
        ("can-jumps-pass", "elif verdict is Verdict.GOOD and self._jumps(values, t_ns):", "elif False:"),
        ("can-quality-unread", "if quality and raw[quality] != self._message.quality_ok:", "if False:"),
        ("can-reserved-unread", 'if int.from_bytes(data, "big") & self._reserved:', "if False:"),
        ("can-silence-ignored", "if now_ns - last_ns > self._timeout_ns and not self._missing:", "if False:"),
        (
            "can-fault-ends-at-once",
            "elif self._fault and bad == 0 and len(self._recent) == WINDOW_FRAMES:",
            "elif self._fault and verdict is Verdict.GOOD:",
        ),
        ("can-nine-bad-frames", "BAD_MAX = 3 ", "BAD_MAX = 9 "),
        (
            "can-faulty-values-used",
            'faults.append(f"can_{fault}:{watch.name}")\n                continue',
            'faults.append(f"can_{fault}:{watch.name}")',
        ),
    ),
    *_of(
        "automodel/config/can.py",
        "tests/firmware_link/test_can_receiver.py",
        ("can-ten-periods", "TIMEOUT_PERIODS = 3.0 ", "TIMEOUT_PERIODS = 10.0 "),
        ("can-timeout-of-1-s", "TIMEOUT_MAX_S = 0.1 ", "TIMEOUT_MAX_S = 1.0 "),
    ),
    *_of(
        "firmware_link/can_port.py",
        "tests/firmware_link/test_can_link.py tests/firmware_link/test_can_port.py",
        ("can-any-frame", "if (frame_id, extended, len(data)) not in self._allowed:", "if False:"),
        ("bus-off-unread", "if error_id & _BUS_OFF:", "if False:"),
    ),
    *_of(
        "firmware_link/can_torque.py",
        "tests/firmware_link/test_can_torque.py",
        ("torque-after-the-end", "self._integral_nm = self.torque_nm = 0.0\n\n    def step", "pass\n\n    def step"),
        ("torque-winds-up", "self.torque_nm == asked_nm or error_rad", "True or error_rad"),
    ),
    *_of(
        "firmware_link/can_limits.py",
        "tests/firmware_link/test_can_limits.py tests/firmware_link/test_can_torque.py",
        ("can-rate-unlimited", "STEERING_RATE_MAX_RADPS = 0.6 ", "STEERING_RATE_MAX_RADPS = 60.0 "),
        ("can-twice-the-acceleration", "LATERAL_ACCEL_MAX_MPS2 = 3.0 ", "LATERAL_ACCEL_MAX_MPS2 = 6.0 "),
        ("can-bank-forgotten", "BANK_TOLERANCE_MPS2 = 0.59", "BANK_TOLERANCE_MPS2 = 0.0"),
        ("can-late-loop-jumps", "DT_MAX_S = 0.04 ", "DT_MAX_S = 4.0 "),
        (
            "can-accel-unlimited",
            "(wanted_mps - measured_mps), -decel_max_mps2, accel_max_mps2)",
            "(wanted_mps - measured_mps), -99.0, 99.0)",
        ),
        ("can-accel-jumps", "_clipped(requested_mps2, before_mps2 - step, before_mps2 + step)", "requested_mps2"),
        ("torque-jumps", "_clipped(requested_nm, before_nm - step, before_nm + step)", "requested_nm"),
        ("torque-unlimited", " + step), -torque_max_nm, torque_max_nm)", " + step), -99.0, 99.0)"),
        ("torque-not-finite", "    if not math.isfinite(requested_nm):\n        requested_nm = 0.0\n", ""),
    ),
    *_of(
        "firmware_link/can_limits.py",
        "tests/firmware_link/test_can_limits.py",
        ("can-jerk-unlimited", "LATERAL_JERK_MAX_MPS3 = 5.0 ", "LATERAL_JERK_MAX_MPS3 = 50.0 "),
        ("can-bend-unlimited", "return _clipped(steering, -most, most)", "return steering"),
        ("can-brakes-not", "        return -decel_max_mps2\n", "        return 0.0\n"),
    ),
)

_LOGIC = "firmware_link/firmware/src/logic/"
BOARD = (
    *_of(
        _LOGIC + "logic.cpp",
        "tests/firmware_link/test_firmware_logic.py",
        ("board-timer-of-1-s", ">= protocol::kCommandTimeoutMs", ">= 10 * protocol::kCommandTimeoutMs"),
        ("any-pulse", " || !is_pulse(command.motor_us)", ""),
        ("old-counters", "if (step == 0 || step > kMaxCounterStep)", "if (step == 0 && step <= kMaxCounterStep)"),
        ("late-commands", "ahead_ms > protocol::kMaxDeadlineMs)", "ahead_ms > 10 * protocol::kMaxDeadlineMs)"),
        ("any-nonce", "message.nonce != nonce_ || ", ""),
        ("nonce-again", "  nonce_ += protocol::kNonceStep;\n", ""),
        ("limits-while-armed", "if (arming_.armed() || !limits_fit(limits)) {", "if (!limits_fit(limits)) {"),
        ("limits-that-do-not-fit", "if (arming_.armed() || !limits_fit(limits)) {", "if (arming_.armed()) {"),
        ("stale-feeds-the-timer", "  } else {\n    pulses_.", "  } else {\n    timer_.feed(t_ms);\n    pulses_."),
        ("disarmed-but-driving", "pulses_.roll_out(t_ms);\n}\n\nbool", "pulses_.tick(t_ms);\n}\n\nbool"),
        ("steers-as-before-the-arm", "  pulses_.straighten();\n  gate_", "  gate_"),
        ("obeys-while-disarmed", "  if (!arming_.armed()) return;\n", ""),
        ("arms-without-limits", "if (!pulses_.limited() || !arming_", "if (!arming_"),
        ("stands-by-a-dead-sensor", "  if (drives && stands) counts_ = false;\n", ""),
        ("stands-between-two-edges", "protocol::kStandGaps * gap_ms_", "1 * gap_ms_"),
        ("flags-unread", "command.flags & ~protocol::command_flag::kFresh", "false"),
    ),
    *_of(
        _LOGIC + "pulses.cpp",
        "tests/firmware_link/test_firmware_logic.py",
        ("servo-unclamped", "clamped(servo_us, limits_.servo_min_us, limits_.servo_max_us)", "servo_us"),
        ("motor-unclamped", "clamped(motor_us, limits_.motor_min_us, limits_.motor_max_us)", "motor_us"),
        ("servo-leaps", "clamped(servo_target_us_, servo_us_ - slew, servo_us_ + slew)", "servo_target_us_ + 0 * slew"),
        ("stops-slowly", "t_ms) {\n  motor_us_ = motor_target_us_", "t_ms) {\n  motor_target_us_"),
        ("rolls-with-the-throttle", "  motor_us_ = motor_target_us_ = limits_.motor_neutral_us;\n  if", "  if"),
        ("rolls-out-for-ever", ">= protocol::kRollOutMs", ">= 10UL * protocol::kRollOutMs"),
        ("roll-out-prolonged", "  if (rolling_) return;\n", ""),
        ("rolls-out-while-it-stands-on-board", "  if (rolling_) straighten();\n", ""),
    ),
    *_of(
        _LOGIC + "board.cpp",
        "tests/firmware_link/test_firmware_logic.py",
        ("timer-unread", "  logic_.tick(t_ms);\n", ""),
    ),
    *_of(
        _LOGIC + "kept.cpp",
        "tests/firmware_link/test_firmware_memory.py",
        ("torn-limits", "return whole && limits_fit", "return (whole || true) && limits_fit"),
        ("kept-limits-that-do-not-fit", "&& limits_fit(protocol::Limits::read(record)) ?", "?"),
        ("boot-id-twice", "return boot_id + 1;", "return boot_id;"),
    ),
    *_of(
        _LOGIC + "frame.cpp",
        "tests/firmware_link/test_firmware_frames.py",
        ("half-a-check", "if (bytes_[stuffed + i] != right[i])", "if (i < 2 && bytes_[stuffed + i] != right[i])"),
        ("any-length", "&& count == payload_bytes + kHeader", "&& count >= payload_bytes + kHeader"),
    ),
    *_of(
        "firmware_link/firmware/src/nano/main.cpp",
        "tests/firmware_link/test_avr.py",
        ("watchdog-of-2-s", "wdt_enable(WDTO_60MS);", "wdt_enable(WDTO_2S);"),
    ),
    *_of(
        "firmware_link/firmware/src/nano/servos.cpp",
        "tests/firmware_link/test_avr.py",
        ("pulses-without-limits", "  if (steering == 0 || motor == 0) return;\n", ""),
    ),
    *_of(
        "firmware_link/firmware/src/nano/store.cpp",
        "tests/firmware_link/test_avr.py",
        ("limits-not-kept", "  written = 0;\n", ""),
    ),
)

JUDGE = (
    *_of(
        "automodel/bench/faults/fault.py",
        "tests/bench/faults/test_judge.py tests/bench/faults/test_plan.py",
        ("judge-of-1-s", "BOUND_S = 0.150 ", "BOUND_S = 1.0 "),
    ),
    *_of(
        "automodel/bench/faults/judge.py",
        "tests/bench/faults/test_judge.py",
        ("judge-lets-drive-off", "if again_ns is not None:", "if False:"),
        ("judge-sees-no-limits", "if not all(servo_low <= servo", "if False and all(servo_low <= servo"),
        ("judge-sees-no-lane", "if seen.left_m > 0:", "if False:"),
        ("judge-lets-the-car-go-anywhere", "if left_m <= fault.outside_m else", "if True else"),
        ("judge-forgives-any-refusal", "drivable = seen.left_m == 0 and seen.could_start", "drivable = False"),
    ),
)

RIG = (
    *_of(
        "automodel/bench/faults/faulty_parts.py",
        "tests/bench/faults/test_hooks.py",
        ("rig-hides-an-eye", "cameras_of(seen)", "1"),
        ("rig-spoils-no-pair", "            return pair(frame)\n", "            return 0, frame\n"),
    ),
)

CAMERAS = (
    *_of(
        "automodel/sources/cameras.py",
        "tests/sources/test_cameras.py",
        ("arrival-is-capture", "    return now_ns - round(latency_s * _NS)", "    return now_ns"),
        ("any-clock-is-ours", "0 <= now_ns - round(own_ns) <= _OLDEST_NS", "True"),
        ("dead-camera-unnoticed", '("no frame", self._arrived_ns), ', ""),
        ("frozen-camera-unnoticed", ', ("the same frame again and again", self._new_ns)', ""),
        ("slow-camera-unnoticed", "if self._long_waits >= self._steps and", "if False and"),
        ("slow-camera-opened-for-ever", "            self._slow_reported = True\n", ""),
        ("stall-that-never-lasts", "age_s >= _LASTING_S", "False"),
    ),
    *_of(
        "automodel/runtime/supervised_source.py",
        "tests/runtime/test_supervised_source.py",
        ("camera-opened-for-every-stall", "not isinstance(error, SourceStalled) or error.lasting", "True"),
        ("camera-opened-while-driving", "if at_rest and (self._failed", "if (self._failed"),
    ),
    *_of(
        "automodel/sources/csi.py",
        "tests/sources/test_csi.py",
        ("pictures-on-stdout", 'f"fd={fd}", "sync=false"', '"fd=1", "sync=false"'),
        ("damaged-frames-delivered", "return ends == (self._header, _END)", "return True"),
        ("frames-lost-after-damage", "start = start if start > 0 else", "start ="),
    ),
    *_of(
        "automodel/assembly/parts.py",
        "tests/assembly/test_registry.py",
        ("lens-of-another-mode", "if car.other_mode is not None and not any_mode:", "if False:"),
        ("right-lens-of-another-mode", "if car.other_right_mode is not None and not any_mode:", "if False:"),
    ),
)

# Why the bench finds no violation with a mistake: what else stops the car in time.
LAYERS = {
    "frame-time-unchecked": "a command's life is counted from its frame's time: of a wrong time it is stale, or held",
    "restart-ignored": "a board that restarts is disarmed, and takes no Arm with the boot id and nonce before",
    "link-down-ignored": "a link that is down is silent, which stops after LINK_SILENCE_S; and the board's own timer",
    "stall-unnoticed": "the board's timer disarms it, and the host takes that for a stop",
    "limits-skipped": "the board limits the pulses, and how fast they change, once more (`Pulses`)",
    "speed-unlimited": "the planner asks for no more than [control] speed_mps, and the board clamps the motor's pulse",
    "bend-unlimited": "the planner slows down for a bend, and the steering follows the lane",
    "commands-live-1-s": "the board's own 100 ms, and deadlines that it refuses; an old frame holds the car",
    "boot-id-ignored": "a board that restarts is disarmed and says so, and takes no Arm with another boot id",
    "deadline-of-1-s": "a command's own life ends before, and the board's timer",
    "never-looks-again": "with the true lane there is no bound; with --pipeline windows camera-size finds it",
    "pairs-of-any-times-pass": "with the true lane there is no pair; with --pipeline stereo pair-times finds it",
    "pairs-have-no-tolerance": "as above: with --pipeline stereo pair-times finds it",
    "stale-commands-sent": "the board refuses a deadline that is past, and an old frame holds the car",
    "rate-unlimited": "the board limits how far the servo's pulse goes in a servo frame",
    "rolls-out-while-it-stands": "the board ends its roll-out by itself: a disarmed one does not follow the host",
}

BOUNDS = (
    *_of(
        "automodel/estimation/theta/tracked_line.py",
        "tests/estimation/theta/test_tracked_line.py",
        ("hidden-bend-told-by-each-frame", "if near > moved_m:", "if False:"),
    ),
    *_of(
        "automodel/estimation/theta/tracked_lane.py",
        "tests/estimation/theta/test_tracked_lane.py",
        ("forgotten-line-followed", "tracked.rls.heading_variance_here() < self.KNOWN_RAD**2", "True"),
        ("width-ahead-unseen", "self._width_ahead(left, right) if all(seen) else None", "None"),
        ("a-glimpse-is-a-line", "tracked.known_m < TrackedLine.STEP_LANES * self.unit", "False"),
        ("width-ahead-told-by-each-frame", "min(self._since_width_m / s, 1.0)", "1.0"),
    ),
    *_of(
        "automodel/perception/line_scan.py",
        "tests/perception/test_line_scan.py",
        ("worn-paint-is-specks", "self._pieces(lines, (near & paint) | lines)", "self._pieces(lines, lines)"),
    ),
    *_of(
        "automodel/perception/markings/unet.py",
        "tests/perception/markings/test_unet.py",
        ("a-damaged-network-drives", "!= SHIPPED[config.size]", "== data"),
    ),
    *_of(
        "automodel/pipelines/contour.py",
        "tests/pipelines/test_contour_surroundings.py",
        ("a-doubtful-streak-is-paint", "on_streaks(image, points, self.PAINT)", "on_streaks(image, points, 0.0)"),
    ),
    *_of(
        "automodel/tracking/hypotheses.py",
        "tests/tracking/test_hypotheses.py",
        ("new-bends-are-clutter", "if not any(_explains(child, seen) for child in children):", "if False:"),
        ("learnt-twice", "        if not learnt:\n", "        if True:\n"),
        ("picking-has-no-price", "math.lgamma(things + 0.5) - math.lgamma(things - lines + 0.5)", "0.0"),
    ),
    *_of(
        "automodel/tracking/stories.py",
        "tests/tracking/test_hypotheses.py",
        ("whatever-departs-bends", "if at == 0 or", "if True or"),
        ("a-speck-is-a-line", "things.length + share * painted_m[i]", "things.length + 0.0 * painted_m[i]"),
        ("a-second-sight-is-a-witness", "counted[story] + news[i] * (", "counted[story] + ("),
    ),
    *_of(
        "automodel/tracking/stories.py",
        "tests/tracking/test_stories.py",
        ("two-lines-in-a-place", "role[one] == role[look] and high > low", "False"),
    ),
    *_of(
        "automodel/tracking/hypotheses.py",
        "tests/tracking/test_lane_tracking.py",
        ("two-lanes-apart-are-a-lane", "any(left - right == 1.0", "any(left - right <= 2.0"),
        ("lines-are-placed-late", "placed=one.placed and not confusable(one.belief)", "placed=True"),
    ),
    *_of(
        "automodel/tracking/seen_places.py",
        "tests/tracking/test_seen_places.py",
        ("all-is-new", "again[i] = min(again[i], ways[k], ways[after])", "pass"),
    ),
    *_of(
        "automodel/tracking/evidence.py",
        "tests/tracking/test_belief.py",
        (
            "every-point-is-the-line's",
            "3.0 / (2.0 + (rest[i] - common) ** 2 / (variance * prior.point_variance))",
            "1.0",
        ),
        ("bends-through-a-lamp", "wide = max(wide, rest[k] * rest[k] / (noise[k] * prior.point_variance))", "pass"),
        ("a-pixel-is-a-point", "noise[k] = 1.0 + prior.pixel_share * (", "noise[k] = 1.0 + 0.0 * ("),
    ),
    *_of(
        "automodel/tracking/belief.py",
        "tests/tracking/test_hypotheses.py",
        ("no-bend-begins", "+= (self.road.new_bend / unit) ** 2", "+= 0.0"),
        ("bends-begin-where-they-show", "range(math.ceil(shows - 1.0 / STATION)", "range(math.ceil(shows)"),
    ),
    *_of(
        "automodel/tracking/belief.py",
        "tests/tracking/test_belief.py",
        (
            "any-odometry-is-the-same",
            "self._source, self._heading_rad = source, None\n            self._learn()",
            "pass",
        ),
        ("learns-from-one-line", "if heading_rad is None or", "heading_rad = heading_rad or 0.0\n        if"),
    ),
    *_of(
        "automodel/estimation/checked_odometry.py",
        "tests/estimation/test_checked_odometry.py",
        (
            "a-nod-is-a-speed",
            "len(self._others) >= DISSENT and self._tell_one_speed(self._others)",
            "len(self._others) >= DISSENT",
        ),
    ),
    *_of(
        "automodel/estimation/image_motion.py",
        "tests/estimation/test_image_motion.py",
        ("a-line-tells-its-own-way", "(strong < config.edge * weak)", "(strong < 1e9 * weak)"),
        ("noise-is-texture", "(weak > config.texture * variance)", "(weak > 0.0)"),
        ("glare-is-ground", "dark < config.glare * np.median", "dark < 1e9 * np.median"),
        ("far-ahead-all-motions-agree", "> 2.0 * config.sigma_px  # far", "> -1.0  # far"),
    ),
    *_of(
        "automodel/tracking/lane_tracking.py",
        "tests/pipelines/test_centerline_lanes.py",
        (
            "sent-back-with-both-lines",
            "self._confusable(reckoned) or self._is_plain(followed)",
            "self._confusable(reckoned)",
        ),
    ),
    *_of(
        "automodel/tracking/lane_tracking.py",
        "tests/tracking/test_lane_tracking.py",
        ("reckoned-wrong-and-sure", "return here > self.config.gate or beside", "return beside"),
        ("every-nod-turns-the-camera", "max(K * sigma, SLIGHT * ANGLE_RAD)", "0.0"),
        ("roads-are-cameras", "odds < 0.0", "False"),
        ("turned-without-end", "or abs(self.pitch_rad + pitch) > FAR_OFF * ANGLE_RAD", ""),
        (
            "doubts-forget-the-road",
            "self._doubt(belief)\n        self._odometry",
            "self._doubt(belief.without_road())\n        self._odometry",
        ),
        ("odometry-never-learnt", "belief = belief.on(self._learnt_road.reckoning)", "pass"),
        ("learnt-odometry-followed", "= belief.on(self.road), None, None, False", "= belief, None, None, False"),
        (
            "learns-beyond-a-lost-lane",
            "        self._learnt_road.lose()\n        self.in_doubt",
            "        self.in_doubt",
        ),
        ("learns-in-doubt", "        self._learnt_road.lose()\n        return", "        return"),
        ("sent-back-by-the-road-that-was-seen", "reckoned = self._on_any_road", "reckoned = self._reckoned"),
        ("unlikely-stories-bound", "if share > EXCEEDED", "if share > 0.0"),
        (
            "turned-in-doubt",
            "if belief is None or self.in_doubt:\n            self._marked = None",
            "if belief is None:\n            self._marked = None",
        ),
        ("roads-never-get-narrower", "known.without_road(), known.of_any_width()", "(known.without_road(),)"),
        ("surer-than-its-lines", "d, width = d + 0.5 * line, width + 2.0 * line", "pass"),
        ("reckoned-to-the-next-lane", "or beside - here < -2.0 * math.log(EXCEEDED)", ""),
        ("a-gap-may-be-a-lane", "or beside - here < -2.0 * math.log(EXCEEDED)", "or self._confusable(reckoned, 1.0)"),
        ("doubted-and-never-paired", "elif {role for _, role in assigned} >= {LEFT, RIGHT}:", "elif False:"),
        ("wrong-since-now", "since_s = (frame.t_ns - self._learnt_ns) * 1e-9", "since_s = 0.0"),
        ("explains-nothing-and-told", "explains = best.assigned or not alone.all[0].assigned", "explains = True"),
        (
            "nothing-in-view-and-not-told",
            "explains = best.assigned or not alone.all[0].assigned",
            "explains = best.assigned",
        ),
        ("reaches-and-told-in-doubt", "or reaching == [True, True]:", "or (reaching and all(reaching)):"),
        ("lost-by-what-cannot-be", "and not self._confusable(known) else None", "and False else None"),
        ("told-by-what-is-suspected", "return self.reckons and self._odometry.borne_out", "return self.reckons"),
        ("not-a-number-and-coasting", "if known is None or not _is_finite(followed.pose):", "if known is None:"),
        ("dead-and-followed", "elif likelier and self._is_dead(followed, apart, said, best):", "elif False:"),
        ("what-taught-is-forgotten", "self._hypotheses.note([line for line, _ in own], self.road)", "pass"),
        ("reckoned-and-impossible", "story is not None and self._possible(story.pose)", "True"),
        ("specks-are-a-line", "painted_m = min(line.painted_m, speck_m", "painted_m = max(line.painted_m, speck_m"),
        ("another-lane-has-no-bound", "for side in (+1, -1) if self._may_be_another]", "for side in ()]"),
        ("rivals-have-no-bound", "may_be += self._rivals.lanes(self._belief)", "pass"),
        ("rivals-are-its-own-lines", "others = self._rivals.others(belief, lines)", "pass"),
        ("rivals-unseen-by-few-pixels", "return beside or self._looks_again", "return self._looks_again"),
        ("tapers-turn-no-line", "if followed.left.seen and followed.right.seen else 0.5 * TAPER", ""),
        ("drawn-away-step-by-step", "return best.log_odds > -math.log(EXCEEDED) and", "return"),
        ("uncertain-is-excused", "solve(belief.covariance[", "solve((belief.covariance + measured.covariance)["),
        (
            "astray-in-doubt",
            "self._refuted(followed, measured) if own else self._strays(followed)",
            "self._refuted(followed, measured)",
        ),
        ("extrapolated-and-told", "if reaching == [True] and not", "if reaching and not"),
        ("extrapolated-and-kept", "and not any(self._reaching(followed))", "and False"),
        ("without-odometry-believed", "not self.reckons or reaching ==", "reaching =="),
        ("another-lane-is-followed-on", "if self._profile.lanes[lane] > self.config.another:", "if False:"),
    ),
    *_of(
        "automodel/perception/markings/reflections.py",
        "tests/perception/markings/test_reflections.py",
        ("turns-blur-nothing", "math.hypot(self.config.blur_px, turn_px)", "self.config.blur_px"),
        ("standing-cars-blur", "math.hypot(self.config.blur_px, turn_px)", "math.inf"),
        ("a-row-has-a-direction", "max(self._marking_rows, self._marking_px)", "self._marking_rows"),
    ),
    *_of(
        "automodel/tracking/rivals.py",
        "tests/tracking/test_rivals.py",
        (
            "rivals-come-late",
            "before = np.interp(found, self._places, self._looks).tolist()",
            "before = [0.0] * len(found)",
        ),
        ("rivals-never-end", "rival.late += news", "pass"),
        ("rivals-seen-with-one-line", "rival.other or both", "True"),
        ("rivals-out-of-view-missed", "elif self._is_line(in_view_m(rival.role) / belief.road.lane_width_m):", "else:"),
        ("rivals-of-any-width", "and self._width_odds(lane) > least]", "]"),
    ),
    *_of(
        "automodel/tracking/integrity.py",
        "tests/tracking/test_integrity.py",
        ("bound-of-one-sigma", "K = 3.5 ", "K = 1.0 "),
        ("bound-without-the-camera", "max(variance, 0.0) + systematic * systematic", "max(variance, 0.0)"),
        ("bound-never-inflated", "return max(self._mean, 1.0)", "return 1.0"),
    ),
    *_of(
        "automodel/control/longitudinal.py",
        "tests/control/test_longitudinal.py",
        ("fast-in-any-bound", "abs(pose.offset_m) - pose.offset_bound_m", "abs(pose.offset_m)"),
        ("bound-unplanned", "            self._for_pose(estimate, t_ns),\n", ""),
        ("late-frames-unplanned", "            self._for_delay(estimate, t_ns),\n", ""),
        ("bends-unplanned", "            self._for_bends(lane, s_m, speed_mps),\n", ""),
        ("sight-unplanned", "            self._for_sight(estimate, speed_mps),\n", ""),
        ("obstacles-unplanned", "            self._for_obstacle(speed_mps),\n", ""),
    ),
)

PAGE = (
    *_of(
        "automodel/web/remote.py",
        "tests/web/test_remote.py",
        ("page-stop-ignored", "if word is Word.STOP:", "if False:"),
        ("page-stop-lost", "self._reason = self._dead_man.stop()", "self._dead_man.stop()"),
        ("page-gone-unnoticed", "self._dead_man.overdue(now_ns) or self._reason", "self._reason"),
    ),
    *_of(
        "automodel/web/server.py",
        "tests/web/test_server.py",
        ("stop-only-from-the-holder", "if said is not Word.STOP:", "if True:"),
        (
            "page-closed-keeps-the-button",
            "                self._hear(client, Word.RELEASE)\n",
            "                pass\n",
        ),
        ("page-floods", "or client.floods(", "or False and client.floods("),
    ),
    *_of(
        "automodel/web/guard.py",
        "tests/web/test_server.py",
        ("any-token", "self._access.token_fits(first.data)", "bool(first.data)"),
        ("any-host", 'if not self._access.host_fits(request.headers.get("Host")):', "if False:"),
        ("any-origin", "if not self._access.origin_fits(", "if False and not self._access.origin_fits("),
    ),
)

PAIRS = (
    *_of(
        "automodel/sources/pairs.py",
        "tests/sources/test_pairs.py",
        ("any-two-frames-pair", "if abs(late_ns) * 1e-9 <= self.tolerance_s:", "if True:"),
        (
            "the-newer-frame-is-dropped",
            "left if late_ns > 0 else right",
            "right if late_ns > 0 else left",
        ),
        ("eyes-swapped", "left=one.image, right=other.image", "left=other.image, right=one.image"),
    ),
    *_of(
        "automodel/assembly/pair_checks.py",
        "tests/assembly/test_pair_checks.py",
        ("swapped-eyes-pass", "self._order_sigmas < -ORDER_SIGMAS", "False"),
        ("looked-at-while-armed", "if state is not None and state.armed:", "if False:"),
        ("looked-at-in-each-frame", "if self._looks and 0 <=", "if False and 0 <="),
        ("never-looked-at-again", "< LOOK_S * 1e9", "< 1e18"),
    ),
    *_of(
        "automodel/pipelines/stereo.py",
        "tests/pipelines/test_stereo.py",
        ("any-plane-passes", "if self._plane.off_calibration <= FAR_OFF:", "if True:"),
        ("bounce-is-no-plane", "FAR_OFF = 31.8 ", "FAR_OFF = 1.8 "),
    ),
    *_of(
        "automodel/runtime/loop.py",
        "tests/runtime/test_loop.py",
        ("bad-eye-seen", "estimate = self._look(seen, motion)", "estimate = self._look(frame, motion)"),
        (
            "trouble-untold",
            "return estimate, wrong, (*unfit, trouble) if trouble else unfit",
            "return estimate, wrong, unfit",
        ),
    ),
    *_of(
        "automodel/runtime/eye_check.py",
        "tests/runtime/test_eye_check.py",
        ("dark-eye-passes", "if contrast(image) < FLAT_LEVELS:", "if False:"),
        ("stuck-eye-passes", "before is not None and same_image(before, image)", "False"),
        ("good-eye-left-out", "good = 1 if wrong[0] else 0", "good = 0 if wrong[0] else 1"),
    ),
    *_of(
        "automodel/runtime/input_checks.py",
        "tests/runtime/test_input_checks.py",
        ("eye-left-out-is-late", "self._pictures[1 - seen.eye].excuse(frame.t_ns)", "pass"),
        ("one-eye-of-any-times-passes", "self._pair_times.step(frame.right_late_ns, frame.t_ns)", "None"),
    ),
    *_of(
        "automodel/runtime/supervised_source.py",
        "tests/runtime/test_supervised_source.py",
        ("bad-eye-untold", "trouble = unseen if isinstance", 'trouble = "" if isinstance'),
    ),
    *_of(
        "automodel/bench/faults/judge.py",
        "tests/bench/faults/test_judge.py",
        ("armed-though-refused", "if fault.must is Must.REFUSE and moved_ns is not None:", "if False:"),
    ),
)

MUTATIONS = (
    *SAFETY,
    *BY_HAND,
    *LIMITS,
    *BOUNDS,
    *WIRE,
    *BOARD,
    *PAGE,
    *PAIRS,
    *CAMERAS,
    *JUDGE,
    *RIG,
)
