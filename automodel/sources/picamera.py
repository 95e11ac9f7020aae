"""The Raspberry Pi's cameras, through picamera2, which is part of Raspberry Pi OS (apt-get install python3-picamera2).

The package offers it as an entry point, `[camera] source = "picamera2"`, as any other package may offer a camera.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from automodel.config import CameraConfig
from automodel.signals import Frame
from automodel.sources.cameras import captured_ns
from automodel.sources.errors import SourceError

_FLIPS = {"none": (0, 0), "rotate-180": (1, 1), "horizontal": (1, 0), "vertical": (0, 1)}  # hflip, vflip
_FLICKER_MANUAL = 1  # libcamera's FlickerManual


class PicameraSource:
    """Frames of the Pi's camera, with the sensor's own capture time.

    Grey frames are the Y plane as it comes. Raises SourceError where picamera2 is missing, or the camera, or where it
    stops. `read` may block while the camera gives nothing; wrap the source in a `CaptureThread`. `own_time` says
    whether the last frame's time was the sensor's.
    """

    def __init__(self, camera: CameraConfig) -> None:
        try:
            from libcamera import Transform
            from picamera2 import Picamera2
        except ImportError as error:
            raise SourceError(
                f"picamera2 cannot be imported ({error}); apt-get install python3-picamera2, and make the environment "
                "with python3 -m venv --system-site-packages"
            ) from None
        self.own_time = False
        self._camera, self._next = camera, 0
        try:
            self._device = Picamera2(camera.device)
        except (IndexError, RuntimeError) as error:
            raise SourceError(f"Raspberry Pi camera {camera.device}: cannot be opened: {error}") from None
        hflip, vflip = _FLIPS[camera.flip]
        try:
            self._device.configure(self._configuration(Transform(hflip=hflip, vflip=vflip)))
            self._device.start()
        except RuntimeError as error:
            self.close()
            raise SourceError(f"Raspberry Pi camera {camera.device}: cannot be started: {error}") from None

    def read(self, timeout_s: float) -> Frame:
        """The next frame."""
        try:
            request = self._device.capture_request()
        except RuntimeError as error:
            raise SourceError(f"Raspberry Pi camera {self._camera.device}: no more frames: {error}") from None
        try:
            now_ns, boot_ns = time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            stamp_ns = request.get_metadata().get("SensorTimestamp")
            data = np.asarray(request.make_array("main"), dtype=np.uint8)
            height, width = self._camera.height_px, self._camera.width_px
            image = data[:height, :width, :3].copy() if self._camera.colour else data[:height, :width].copy()
        finally:
            request.release()
        # The sensor's time counts the time since the machine was switched on, ours stands still while it sleeps.
        own_ns = None if stamp_ns is None else stamp_ns - (boot_ns - now_ns)
        t_ns = captured_ns(own_ns, now_ns, self._camera.latency_s)
        self.own_time = t_ns == own_ns
        frame = Frame(t_ns=t_ns, index=self._next, image=image)
        self._next += 1
        return frame

    def close(self) -> None:
        """Release the camera; may be called twice."""
        self._device.close()

    def _configuration(self, transform: object) -> Any:
        camera = self._camera
        controls: dict[str, object] = {"FrameRate": camera.rate_hz}
        if camera.exposure_s > 0.0:
            controls["ExposureTime"] = round(camera.exposure_s * 1e6)
        if camera.gain > 0.0:
            controls["AnalogueGain"] = camera.gain
        if camera.exposure_s > 0.0 and camera.gain > 0.0:
            controls["AeEnable"] = False
        if camera.flicker_hz:  # lamps are bright twice in a period of the mains
            controls |= {"AeFlickerMode": _FLICKER_MANUAL, "AeFlickerPeriod": round(0.5e6 / camera.flicker_hz)}
        more: dict[str, object] = {}
        if camera.sensor_mode >= 0:
            modes = self._device.sensor_modes
            if camera.sensor_mode >= len(modes):
                raise SourceError(
                    f"Raspberry Pi camera {camera.device}: expected [camera] sensor_mode 0 .. {len(modes) - 1}, "
                    f"got {camera.sensor_mode}"
                )
            mode = modes[camera.sensor_mode]
            more["sensor"] = {"output_size": mode["size"], "bit_depth": mode["bit_depth"]}
        return self._device.create_video_configuration(
            main={"size": (camera.width_px, camera.height_px), "format": "RGB888" if camera.colour else "YUV420"},
            transform=transform,
            controls=controls,
            buffer_count=3,
            queue=False,  # the next frame, not one that waited
            **more,
        )
