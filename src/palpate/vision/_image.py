"""Pictures in: from files and arrays, checked, and brought to the sizes the detector works at."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from ..errors import InputError

Image = npt.NDArray[np.uint8]
Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

SMALLEST = 64
"""shorter side of a usable picture [pixels]"""


def load(path: str | PathLike[str]) -> Image:
    """A picture file as (H, W, 3) BGR.

    Raises:
        InputError: it is not there, is no picture, or is too small.
    """
    file = Path(path)
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from None
    image = None
    if content:
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        except cv2.error:  # absurd sizes in the header
            image = None
    if image is None:
        raise InputError(f"{file}: not a picture that can be read (PNG, JPEG, BMP, TIFF, WebP, PNM)")
    return checked(image, str(file))


def png(image: Image) -> bytes:
    """A picture (H, W, 3) BGR as a PNG file."""
    return cv2.imencode(".png", image)[1].tobytes()


def checked(image: npt.ArrayLike, name: str = "image") -> Image:
    """The picture as (H, W, 3) BGR; grey pictures get three equal channels, an alpha channel is dropped.

    Raises:
        InputError: another shape or type, or too small.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (1, 3, 4))):
        raise InputError(
            f"{name}: expected uint8 (H, W) grey, (H, W, 3) BGR or (H, W, 4), got {array.dtype} {array.shape}"
        )
    if min(array.shape[:2]) < SMALLEST:
        raise InputError(
            f"{name}: {array.shape[1]}x{array.shape[0]} pixels are too few; expected at least "
            f"{SMALLEST} on the shorter side"
        )
    if array.ndim == 2 or array.shape[2] == 1:
        return cv2.cvtColor(np.ascontiguousarray(array.reshape(array.shape[:2])), cv2.COLOR_GRAY2BGR)
    return np.ascontiguousarray(array[..., :3])


def shrunk(image: Image, long_side: int) -> tuple[Image, float]:
    """The picture with at most `long_side` pixels on its longer side, and the factor by which it shrank (<= 1)."""
    scale = min(1.0, long_side / max(image.shape[:2]))
    if scale == 1.0:
        return image, 1.0
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    smooth = cv2.INTER_AREA
    while image.shape[1] >= 2 * size[0] and image.shape[0] % 2 == 0 and image.shape[1] % 2 == 0:
        # the mean of 2x2 pixels: many times quicker than other factors, and the same
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
        smooth = (
            cv2.INTER_LINEAR
        )  # what is left is less than a factor of 2 of a picture that is smooth already
    return cv2.resize(image, size, interpolation=smooth), scale


def rescaled(points: npt.ArrayLike, scale: float) -> npt.NDArray[np.float64]:
    """Points (..., 2) of a picture in one that is `scale` times as large; pixel centres are whole numbers in both."""
    return (np.asarray(points, np.float64) + 0.5) * scale - 0.5
