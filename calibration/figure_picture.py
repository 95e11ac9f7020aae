"""A figure of matplotlib as a picture."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import cv2
import numpy as np

from automodel.types import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def picture_of(figure: Figure) -> Image:
    """The figure as it would be saved: (h, w, 3) BGR."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return np.asarray(cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
