"""[pipeline]: which paper sees the lane, and each one's own keys."""

from __future__ import annotations

from dataclasses import dataclass, field

from automodel.config.parts import PIPELINES
from automodel.config.toml_reader import not_negative, one_of, positive


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowsConfig:
    """`windows` (Balbuena Palma et al. 2020). Lengths in lane widths hold at any scale."""

    view_ahead_lanes: float = 3.0  # how far ahead of the first visible ground the bird's-eye view reaches
    view_half_lanes: float = 1.6  # half the bird's-eye view's width
    marking_px: float = 5.0  # pixels that the marking is wide in the bird's-eye view
    contrast: float = 0.0  # grey levels that a marking stands above its surroundings, at least; 0: from the noise
    coast_lanes: float = 4.0  # distance that the lane is carried on without any line, at most
    coast_s: float = 2.0  # and for how long at most

    def __post_init__(self) -> None:
        positive(self, "view_ahead_lanes", "view_half_lanes", "marking_px")
        not_negative(self, "coast_lanes", "coast_s")


NETWORK_PROVIDERS = ("tensorrt", "cuda", "openvino", "cpu")  # what may run the network, tried in this order


@dataclass(frozen=True, slots=True, kw_only=True)
class CenterlineConfig:
    """`centerline` (Cudrano et al. 2020). Lengths are multiples of the lane's width, so that they hold at any scale."""

    markings: str = "unet"  # what finds the markings: the network, or the classical "ridge" filter
    network: str = "birdseye"  # sees the road from above; "512x256" and "256x128" see the picture, at that size [px]
    model: str = ""  # an ONNX file; empty: the weights that are shipped
    providers: tuple[str, ...] = ("tensorrt", "cuda", "cpu")  # tried in the order of `NETWORK_PROVIDERS`
    threads: int = 0  # of the network on the CPU; 0: half of the cores
    threshold: float = 0.5  # probability from which a pixel is a marking
    view_ahead_lanes: float = 3.0  # how far ahead of the first visible ground the bird's-eye view reaches
    view_half_lanes: float = 1.8  # half the bird's-eye view's width
    marking_px: float = 4.0  # pixels that the marking is wide in the bird's-eye view
    coast_lanes: float = 5.0  # distance that the lane is carried on without any line, at most
    coast_s: float = 2.5  # and for how long at most

    def __post_init__(self) -> None:
        one_of("markings", self.markings, ("unet", "ridge"))
        one_of("network", self.network, ("512x256", "256x128", "birdseye"))
        for name in self.providers:
            one_of("providers", name, NETWORK_PROVIDERS)
        positive(self, "threshold", "view_ahead_lanes", "view_half_lanes", "marking_px")
        not_negative(self, "threads", "coast_lanes", "coast_s")
        if self.threshold >= 1.0:
            raise ValueError(f"threshold: expected a probability below 1, got {self.threshold}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ContourConfig:
    """`contour` (Smith 2024). Lengths are multiples of the lane's width, so that they hold at any scale."""

    look_ahead_lanes: float = 2.5  # how far ahead of the first visible ground the lines are followed
    nodes: int = 18  # places at which a line is looked for
    piece_lanes: float = 0.5  # length of a clothoid of the chain that the lane is
    radius_lanes: float = (
        1.4  # of the road's tightest bend, for which the speed allows out of sight, and as which a new bend is weighed;
        # some 50 on a highway, where every pipeline starts on dashes
    )
    contrast: float = 0.0  # grey levels that a marking stands above its surroundings, at least; 0: from the noise
    colour: str = "grey"  # what is read of a colour image: "blue", "green", "red", or their weighted sum "grey"
    update: str = "gauss_newton"  # or "gradient_descent", as in the thesis
    precision: str = "double"  # or "single", for boards that have no fast doubles
    coast_lanes: float = 6.0  # distance that the lane is carried on without any line, at most
    coast_s: float = 2.5  # and for how long at most

    def __post_init__(self) -> None:
        one_of("colour", self.colour, ("grey", "blue", "green", "red"))
        one_of("update", self.update, ("gauss_newton", "gradient_descent"))
        one_of("precision", self.precision, ("double", "single"))
        positive(self, "look_ahead_lanes", "piece_lanes", "radius_lanes")
        not_negative(self, "coast_lanes", "coast_s")
        if not 4 <= self.nodes <= 100:
            raise ValueError(f"nodes: expected 4 .. 100, got {self.nodes}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConfig:
    """`stereo` (wide-baseline stereo lanes). Lengths are multiples of the lane's width, so that they hold at any scale.

    It needs a second camera: `[camera.right.intrinsics]` and `[camera.right.extrinsics]`.
    """

    look_ahead_lanes: float = 3.0  # how far ahead of the first visible ground stripes are looked for; 14 on a highway
    view_half_lanes: float = 1.6  # how far to each side of the predicted lane
    rows: int = 64  # image rows that are read of each camera
    contrast: float = 0.0  # grey levels that a marking stands above its surroundings, at least; 0: from the noise
    coast_lanes: float = 6.0  # distance that the lane is carried on without any line, at most
    coast_s: float = 2.5  # and for how long at most
    lane_changes: bool = False  # true: the next lane becomes the lane when the car drives there; it leads the same way

    def __post_init__(self) -> None:
        positive(self, "look_ahead_lanes", "view_half_lanes")
        not_negative(self, "contrast", "coast_lanes", "coast_s")
        if not 8 <= self.rows <= 400:
            raise ValueError(f"rows: expected 8 .. 400, got {self.rows}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineConfig:
    """Which paper sees the lane, and each one's own keys."""

    name: str = "centerline"
    centerline: CenterlineConfig = field(default_factory=CenterlineConfig)
    contour: ContourConfig = field(default_factory=ContourConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    windows: WindowsConfig = field(default_factory=WindowsConfig)

    def __post_init__(self) -> None:
        PIPELINES.check("name", self.name)

    def coasting(self, lane_width_m: float) -> tuple[float, float]:
        """Distance [m] and time [s] for which the lane may be carried on without any line, at most.

        Those of the pipeline in use; of `centerline` for one that does not come with automodel.
        """
        sections: dict[str, WindowsConfig | ContourConfig | StereoConfig] = {
            "windows": self.windows,
            "contour": self.contour,
            "stereo": self.stereo,
        }
        section = sections.get(self.name, self.centerline)
        return section.coast_lanes * lane_width_m, section.coast_s
