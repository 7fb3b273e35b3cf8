"""The camera: its calibration, where a board is in space, and board coordinates in metres.

Frames. Camera: OpenCV's, x right, y down, z forward, origin in the lens. Board: origin in corner 0 of the writing
surface (top left), x along the top edge to corner 1, y down the left edge to corner 3, z into the board; unit metre.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..errors import InputError
from ._image import checked

_KIND = "palpate camera 1"
_FEWEST_VIEWS = 4


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera. Distortion: k1, k2, p1, p2, k3 (Brown-Conrady, as OpenCV has it)."""

    K: Array
    """(3, 3) pinhole matrix [pixels]"""
    distortion: Array
    """(5,)"""
    size: tuple[int, int]
    """width and height of its pictures [pixels]"""
    T_base_camera: Array | None = None
    """(4, 4) where the camera is in the robot's base frame [m]; None: not known"""
    rms: float = float("nan")
    """root mean square reprojection error of the calibration [pixels]"""

    def __post_init__(self) -> None:
        K, d = np.asarray(self.K, np.float64), np.asarray(self.distortion, np.float64).ravel()
        if K.shape != (3, 3) or not np.all(np.isfinite(K)) or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(
                f"camera: K must be a finite (3, 3) pinhole matrix with positive focal lengths, got {K.tolist()}"
            )
        if d.shape != (5,) or not np.all(np.isfinite(d)):
            raise InputError(f"camera: distortion must be k1, k2, p1, p2, k3, got {d.tolist()}")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", d)
        if self.T_base_camera is not None:
            T = np.asarray(self.T_base_camera, np.float64)
            if T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6):
                raise InputError("camera: T_base_camera must be a (4, 4) rigid transform")
            object.__setattr__(self, "T_base_camera", T)

    def for_picture(self, width: int, height: int) -> Camera:
        """The same camera for pictures of another resolution.

        Raises:
            InputError: another shape of picture: a crop cannot be told from a resize.
        """
        if (width, height) == self.size:
            return self
        scale = width / self.size[0]
        if abs(height - scale * self.size[1]) > 1.0:
            raise InputError(
                f"camera calibrated for {self.size[0]}x{self.size[1]} pictures, got {width}x{height}: "
                "give a picture of the same shape, or calibrate for this one"
            )
        K = self.K.copy()
        K[:2] *= scale
        K[:2, 2] += 0.5 * (scale - 1.0)  # whole numbers are pixel centres
        return Camera(K, self.distortion, (width, height), self.T_base_camera, self.rms * scale)

    def straightened(self, points: npt.ArrayLike) -> Array:
        """Pixels (..., 2) as a lens without distortion would show them, same K."""
        p = np.asarray(points, np.float64)
        if not len(p.reshape(-1, 2)):
            return p
        return cv2.undistortPoints(p.reshape(-1, 1, 2), self.K, self.distortion, P=self.K).reshape(p.shape)

    def project(self, points: npt.ArrayLike) -> Array:
        """Points (..., 3) in the camera frame [m] as pixels (..., 2)."""
        p = np.asarray(points, np.float64)
        seen = cv2.projectPoints(p.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.K, self.distortion)[0]
        return seen.reshape(*p.shape[:-1], 2)

    def save(self, path: str | PathLike[str]) -> Path:
        """Write a card (JSON)."""
        target = Path(path)
        card = {
            "kind": _KIND,
            "width": self.size[0],
            "height": self.size[1],
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
            "rms_pixels": None if np.isnan(self.rms) else self.rms,
            "T_base_camera": None if self.T_base_camera is None else self.T_base_camera.tolist(),
        }
        try:
            target.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{target}: cannot be written: {error.strerror or error}") from None
        return target

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Camera:
        """Read a card.

        Raises:
            InputError: no such file, or not a camera card.
        """
        file = Path(path)
        try:
            card = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{file}: not a camera card: {getattr(error, 'strerror', None) or error}"
            ) from None
        if not isinstance(card, dict) or card.get("kind") != _KIND:
            raise InputError(f"{file}: not a camera card: expected the field kind with {_KIND!r}")
        try:
            rms = card.get("rms_pixels")
            return cls(
                np.array(card["K"], np.float64),
                np.array(card["distortion"], np.float64),
                (int(card["width"]), int(card["height"])),
                None if card.get("T_base_camera") is None else np.array(card["T_base_camera"], np.float64),
                float("nan") if rms is None else float(rms),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file}: camera card: field {error} is missing or wrong") from None


def charuco(
    squares: tuple[int, int] = (7, 5), square: float = 0.04, marker: float = 0.03
) -> cv2.aruco.CharucoBoard:
    """The calibration board (DICT_5X5_100): so many `squares` across and down of side `square`, with markers [m]."""
    if min(squares) < 3 or not 0.0 < marker < square:
        raise InputError(
            f"ChArUco board: expected at least 3x3 squares and 0 < marker < square, got {squares}, marker {marker} m, "
            f"square {square} m"
        )
    return cv2.aruco.CharucoBoard(
        squares, square, marker, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )


def calibrate_charuco(images: Sequence[npt.ArrayLike], board: cv2.aruco.CharucoBoard) -> Camera:
    """Calibrate from pictures of a ChArUco board in different poses.

    Args:
        images: at least four pictures of one size; those in which fewer than six corners are seen do not count.
        board: of :func:`charuco`.

    Raises:
        InputError: too few usable pictures, or pictures of several sizes.
    """
    detector = cv2.aruco.CharucoDetector(board)
    objects, pixels, sizes = [], [], set()
    for k, image in enumerate(images):
        picture = checked(image, f"picture {k}")
        sizes.add((picture.shape[1], picture.shape[0]))
        corners, ids, _, _ = detector.detectBoard(picture)
        if ids is None or len(ids) < 6:
            continue
        where, what = board.matchImagePoints(corners, ids)
        objects.append(where.reshape(-1, 3))
        pixels.append(what.reshape(-1, 2))
    if len(sizes) > 1:
        raise InputError(f"calibration: pictures of one size expected, got {sorted(sizes)}")
    if len(objects) < _FEWEST_VIEWS:
        raise InputError(
            f"calibration: the ChArUco board was found in {len(objects)} of {len(images)} pictures; at least "
            f"{_FEWEST_VIEWS} are needed, from different sides"
        )
    return _calibrated(objects, pixels, sizes.pop())


def calibrate_poses(points: npt.ArrayLike, pixels: npt.ArrayLike, size: tuple[int, int]) -> Camera:
    """Calibrate from points at known places in the robot's base frame, such as a marker on the hand in known poses.

    Args:
        points: (N, 3) in the base frame [m], N >= 8, not all in one plane.
        pixels: (N, 2) where they are seen.
        size: width and height of the pictures [pixels].

    Returns:
        the camera with ``T_base_camera``; distortion only k1, the points being few.

    Raises:
        InputError: too few points, or all in one plane.
    """
    p, q = np.asarray(points, np.float64), np.asarray(pixels, np.float64)
    if p.ndim != 2 or p.shape[1:] != (3,) or q.shape != (len(p), 2) or len(p) < 8:
        raise InputError(
            f"calibration: expected points (N, 3) and pixels (N, 2), N >= 8, got {p.shape} and {q.shape}"
        )
    centred = p - p.mean(0)
    depth = np.linalg.svd(centred, compute_uv=False)
    if depth[2] < 0.02 * depth[0]:
        raise InputError(
            "calibration: the points lie in one plane; move the hand towards the camera and away as well"
        )
    guess = _direct(p, q, size)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, K, d, rotation, shift = cv2.calibrateCamera(
        [p.astype(np.float32)], [q.astype(np.float32)], size, guess, np.zeros(5), flags=flags
    )
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3], T_camera_base[:3, 3] = cv2.Rodrigues(rotation[0])[0], shift[0].ravel()
    return Camera(K, d.ravel()[:5], size, np.linalg.inv(T_camera_base).astype(np.float64), float(rms))


def _direct(points: Array, pixels: Array, size: tuple[int, int]) -> Array:
    """K by the direct linear transform, its focal lengths; the principal point in the middle."""
    mean, scale = points.mean(0), np.std(points) + 1e-12
    X = np.column_stack([(points - mean) / scale, np.ones(len(points))])
    middle = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    x = (pixels - middle) / max(size)
    zero = np.zeros_like(X)
    A = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])])
    P = np.linalg.svd(A)[2][-1].reshape(3, 4)
    K = cv2.RQDecomp3x3(P[:, :3])[1]
    K = np.abs(K / K[2, 2])
    focal = float(np.clip(np.sqrt(K[0, 0] * K[1, 1]), 0.3, 10.0)) * max(size)
    return np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])


def _calibrated(objects: list[Array], pixels: list[Array], size: tuple[int, int]) -> Camera:
    rms, K, d, _, _ = cv2.calibrateCamera(
        [o.astype(np.float32) for o in objects], [p.astype(np.float32) for p in pixels], size, None, None
    )
    return Camera(K, d.ravel()[:5], size, None, float(rms))


@dataclass(frozen=True, slots=True)
class Plane:
    """A board's surface as the camera sees it: pixels to board coordinates and back."""

    size: tuple[float, float]
    """width along the top edge and height along the left edge [m]; without a known size the height is 1"""
    metric: bool
    """the size is given in metres; False: only the shape is known, the height counts as 1"""
    camera: Camera | None
    """None: not calibrated; then the lens is taken to be free of distortion"""
    H_board_pixel: Array
    """(3, 3) from straightened pixels to board coordinates"""
    T_camera_board: Array | None
    """(4, 4) the board in the camera frame, in units of the size; None without a camera"""

    @property
    def T_base_board(self) -> Array | None:
        """(4, 4) the board in the robot's base frame [m]; None unless the camera's place and the size are known."""
        if (
            self.T_camera_board is None
            or self.camera is None
            or self.camera.T_base_camera is None
            or not self.metric
        ):
            return None
        return self.camera.T_base_camera @ self.T_camera_board

    def to_board(self, pixels: npt.ArrayLike) -> Array:
        """Pixels (..., 2) on the board in board coordinates (..., 2)."""
        p = np.asarray(pixels, np.float64)
        straight = p if self.camera is None else self.camera.straightened(p)
        return _through(self.H_board_pixel, straight)

    def to_pixels(self, points: npt.ArrayLike) -> Array:
        """Board coordinates (..., 2) as pixels (..., 2)."""
        p = np.asarray(points, np.float64)
        straight = _through(np.linalg.inv(self.H_board_pixel).astype(np.float64), p)
        if self.camera is None:
            return straight
        rays = (straight - self.camera.K[:2, 2]) / np.diag(self.camera.K)[:2]
        return self.camera.project(np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], -1))


def _through(H: Array, points: Array) -> Array:
    if not points.size:
        return points
    return cv2.perspectiveTransform(points.reshape(1, -1, 2), H).reshape(points.shape)


def plane(
    corners: npt.ArrayLike,
    picture: tuple[int, int],
    *,
    size: tuple[float, float] | None = None,
    camera: Camera | None = None,
) -> Plane:
    """Board coordinates from the corners of a writing surface.

    Args:
        corners: (4, 2) [pixels], clockwise from the top left.
        picture: width and height of the picture [pixels].
        size: width and height of the writing surface [m]; None: its shape is estimated, its height counts as 1.
        camera: None: not calibrated; the shape is then estimated for a lens without distortion.
    """
    q = np.asarray(corners, np.float64)
    if q.shape != (4, 2) or not np.all(np.isfinite(q)):
        raise InputError(f"corners must be (4, 2) and finite, got {q.shape}")
    if size is not None and not (np.all(np.isfinite(size)) and min(size) > 0.0):
        raise InputError(
            f"board size: expected width and height in metres, both positive, got {size[0]:g} {size[1]:g}"
        )
    if camera is not None:
        camera = camera.for_picture(*picture)
        q = camera.straightened(q)
    whole = (aspect(q, picture, None if camera is None else camera.K), 1.0) if size is None else size
    target = np.array([[0, 0], [whole[0], 0], [whole[0], whole[1]], [0, whole[1]]])
    H = cv2.getPerspectiveTransform(q.astype(np.float32), target.astype(np.float32))
    H = cv2.findHomography(q, target)[0] if H is None else H
    T = None
    if camera is not None:
        ok, rotation, shift = cv2.solvePnP(
            np.column_stack([target, np.zeros(4)]), q, camera.K, None, flags=cv2.SOLVEPNP_IPPE
        )
        if ok:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
    return Plane(whole, size is not None, camera, H, T)


def aspect(corners: npt.ArrayLike, picture: tuple[int, int], K: Array | None = None) -> float:
    """Width over height of a rectangle from its four corners in a picture.

    Z. Zhang, L.-W. He, "Whiteboard scanning and image enhancement", Digital Signal Processing 17 (2007): the two sides
    are perpendicular in space, which gives the focal length where it is not known; where the view is so straight that
    it does not, the sides as seen are compared.

    Args:
        corners: (4, 2) [pixels], clockwise from the top left, without lens distortion.
        picture: width and height of the picture [pixels].
        K: (3, 3); None: square pixels, the principal point in the middle.
    """
    middle = np.array([(picture[0] - 1) / 2.0, (picture[1] - 1) / 2.0]) if K is None else K[:2, 2]
    m1, m2, m4, m3 = (np.array([*(c - middle), 1.0]) for c in np.asarray(corners, np.float64))
    k2 = np.dot(np.cross(m1, m4), m3) / np.dot(np.cross(m2, m4), m3)
    k3 = np.dot(np.cross(m1, m4), m2) / np.dot(np.cross(m3, m4), m2)
    n2, n3 = k2 * m2 - m1, k3 * m3 - m1
    seen = float(np.linalg.norm(m2[:2] - m1[:2]) + np.linalg.norm(m4[:2] - m3[:2])) / float(
        np.linalg.norm(m3[:2] - m1[:2]) + np.linalg.norm(m4[:2] - m2[:2])
    )
    longest = float(max(picture))
    if K is not None:
        fx, fy = K[0, 0], K[1, 1]
    else:
        if min(abs(n2[2]), abs(n3[2])) < 0.02:  # one pair of sides is nearly parallel: no vanishing point
            return seen
        square = -(n2[0] * n3[0] + n2[1] * n3[1]) / (n2[2] * n3[2])
        if not (0.3 * longest) ** 2 < square < (10.0 * longest) ** 2:
            return seen
        fx = fy = float(np.sqrt(square))
    scale = np.array([1.0 / fx**2, 1.0 / fy**2, 1.0])
    return float(np.sqrt((n2**2 @ scale) / (n3**2 @ scale)))
