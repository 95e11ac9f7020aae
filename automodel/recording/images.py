"""Frames <-> foxglove.CompressedImage messages."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from automodel.config import RecordingConfig
from automodel.types import Image

CAMERA, LEFT, RIGHT = "/camera", "/camera/left", "/camera/right"
CAMERA_TOPICS = (CAMERA, LEFT, RIGHT)
SCHEMA = "foxglove.CompressedImage"


class ImageCodec:
    """Compresses pictures as `[recording]` says: PNG keeps every bit, JPEG does not.

    PNG with run-length matching only (Huffman over filtered rows) is several times faster than zlib's usual search,
    and hardly larger on pictures with sensor noise.
    """

    def __init__(self, config: RecordingConfig) -> None:
        self.format = config.image
        if config.image == "png":
            strategy = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
            self._options = [cv2.IMWRITE_PNG_COMPRESSION, 1, *strategy]
        else:
            self._options = [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]

    def encode(self, t_ns: int, image: Image) -> bytes:
        """A serialised CompressedImage; raises ValueError for a picture that cannot be compressed (an empty one)."""
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        try:
            data = cv2.imencode(f".{self.format}", image, self._options)[1].tobytes()
        except cv2.error as error:
            raise ValueError(f"image: shape {image.shape} cannot be compressed as {self.format}") from error
        message: Any = CompressedImage(frame_id="camera", data=data, format=self.format)
        message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 1_000_000_000)
        return bytes(message.SerializeToString())


def decode_image(data: bytes) -> Image:
    """The picture of a serialised CompressedImage, grey or BGR as it was; raises ValueError where it is none."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from google.protobuf.message import DecodeError

    try:
        packed = bytes(CompressedImage.FromString(data).data)
    except DecodeError:
        raise ValueError("not a CompressedImage message") from None
    image = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_UNCHANGED) if packed else None
    if image is None or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError("a damaged picture")
    return np.asarray(image, dtype=np.uint8)


def descriptor_set() -> bytes:
    """The protobuf schema of CompressedImage, as MCAP wants it."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from mcap_protobuf.schema import build_file_descriptor_set

    return bytes(build_file_descriptor_set(CompressedImage).SerializeToString())
