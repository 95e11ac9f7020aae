"""The run: one turn after the other until someone says stop, and the car in neutral however it ends.

A turn waits for the newest frame, at most 20 ms, so that the vehicle is polled, the safety machine stepped and a
signal answered at that pace whatever the camera does. What goes to the wire goes first; recording, telling and the
collector come after it. The whole run lives on the clock it is given: with a `VirtualClock` and a source that
advances it inside `read` the same code runs in lock-step.
"""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from automodel import interrupts
from automodel.clocks import NS_PER_S
from automodel.journal import Journal
from automodel.loop import Tick, state_faults
from automodel.run_parts import RunConfig, RunEnd, RunObserver, RunParts, RunResult, TickRecord
from automodel.safety import Action, SafetyDecision, SafetyInputs, SafetyMode, Seen
from automodel.signals import NEUTRAL, Command, Frame, LaneEstimate, LaneStatus, Motion, StereoFrame, VehicleState
from automodel.sources.errors import EndOfSource
from automodel.supervised_link import SupervisedLink
