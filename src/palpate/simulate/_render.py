"""Pictures of the plant: camera placement and the OpenGL context, which may be missing."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..errors import InputError, PalpateError
from . import _model


@dataclass(frozen=True, slots=True)
class Camera:
    """Where a picture is taken from. Angles are of the line of sight; up is up, whatever the arm's mount."""

    azimuth: float | None = 135.0
    """about the vertical [deg]; None: across the plane the arm reaches in as it stands, a little from ahead"""
    elevation: float = -18.0
    """< 0 looks down [deg]"""
    distance: float | None = None
    """to `lookat` [m]; None: 1.3 times the arm's reach"""
    lookat: tuple[float, float, float] | None = None
    """point in the middle of the picture, base frame [m]; None: the middle of the arm as it stands"""


class Studio:
    """One offscreen renderer of one size.

    Raises:
        InputError: the size is out of range.
        PalpateError: no OpenGL context could be made.
    """

    def __init__(self, model: Any, width: int, height: int) -> None:
        limit = _model.OFFSCREEN
        if not (1 <= width <= limit[0] and 1 <= height <= limit[1]):
            raise InputError(f"a picture must be 1x1 to {limit[0]}x{limit[1]} pixels, got {width}x{height}")
        self.size = (width, height)
        self._mj = _model.mujoco()
        self._model = model
        self._renderer = None
        try:
            with warnings.catch_warnings():
                # glfw warns of the missing display on its own; the error below says it once
                warnings.simplefilter("ignore")
                self._renderer = self._mj.Renderer(model, height, width)
        except (ImportError, AttributeError, RuntimeError, OSError, self._mj.FatalError) as error:
            backend = os.environ.get("MUJOCO_GL") or "the default"
            raise PalpateError(
                f"rendering needs OpenGL, which MuJoCo could not start with MUJOCO_GL={backend} ({error}); "
                "without a display set MUJOCO_GL=egl (or osmesa) before Python starts, "
                'install libegl1 (or libosmesa6) and `pip install "palpate[sim]"`'
            ) from error

    def picture(
        self, data: Any, camera: Camera | str, R_world_base: Array, extent: float
    ) -> npt.NDArray[np.uint8]:
        """Draw `data`; (height, width, 3) uint8."""
        mj = self._mj
        assert self._renderer is not None
        if isinstance(camera, str):
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            if camera not in names:
                raise InputError(f"no camera {camera!r} in the scene; there are {', '.join(names) or 'none'}")
            self._renderer.update_scene(data, camera)
        else:
            view = mj.MjvCamera()
            view.type = mj.mjtCamera.mjCAMERA_FREE
            arm = [i for i in range(self._model.nbody) if self._model.body(i).name.startswith("arm:")]
            points = data.xpos[arm]
            view.azimuth = _across(points) if camera.azimuth is None else camera.azimuth
            view.elevation = camera.elevation
            view.distance = 1.3 * extent if camera.distance is None else camera.distance
            if camera.lookat is None:
                view.lookat[:] = 0.5 * (points.min(axis=0) + points.max(axis=0))
            else:
                view.lookat[:] = R_world_base @ np.asarray(camera.lookat)
            self._renderer.update_scene(data, view)
        picture: npt.NDArray[np.uint8] = self._renderer.render().copy()
        return picture

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _across(points: Array) -> float:
    """Azimuth [deg] that sees a chain of points, world frame (n, 3), from the side; the default if upright."""
    x, y = points[-1, :2] - points[0, :2]
    if np.hypot(x, y) < 0.1 * np.linalg.norm(np.ptp(points, axis=0)):
        return 135.0
    return float(np.degrees(np.arctan2(y, x))) + 110.0
