"""A run on disk: joints, wrenches, forces, tasks, events and pictures, written while the arms move."""

from __future__ import annotations

from os import PathLike
from types import TracebackType

import cv2
import numpy as np

from ..errors import MissingExtraError
from ..logs import Recorder
from .options import JobOptions
from .result import Event, Look, Observer, Tick
from .scene import BoardScene

QUALITY = 90
"""of the camera's pictures, JPEG"""


class RunRecorder(Observer):
    """Writes a rosbag2 recording of a job; see :class:`palpate.logs.Recorder` for what survives a crash.

    Joints of both arms are in ``/joint_states``, the eraser's first. Further signals: ``commanded_wrench``,
    ``estimated_wrench`` and its ``_std`` (base axes of the eraser's arm), ``wanted_force``, ``normal_force``,
    ``true_force`` and ``true_normal_force`` (of the simulated contact), ``tool_position``, ``board_position``,
    ``board_position_seen``, ``pass_number``, ``stroke``, ``yielding``, ``held``. Tasks and phases are events, like
    everything else that happens; pictures are ``/camera/image/compressed``.

    Args:
        path: see :class:`palpate.logs.Recorder`.
        scene: what is wiped.
        options: how.
        overwrite: replace what is there.

    Raises:
        LogError: the file is there, or cannot be written.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        scene: BoardScene,
        options: JobOptions,
        *,
        overwrite: bool = False,
    ) -> None:
        names = [
            f"{who}/{joint.name}"
            for who, arm in zip(("eraser", "holder"), scene.arms, strict=True)
            for joint in arm.joints
        ]
        session = {
            "eraser_arm": scene.arms[0].name,
            "holder_arm": scene.arms[1].name,
            "board_size": f"{scene.ink.size[0]:g} x {scene.ink.size[1]:g} m",
            "options": repr(options),
            "setting": repr(scene.setting),
        }
        self._out = Recorder(path, names, session=session, overwrite=overwrite)
        self._where = ("", "")
        self.remark = ""
        """what could not be recorded, one sentence; empty: everything is"""

    def __enter__(self) -> RunRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._out.close()

    def tick(self, tick: Tick) -> None:
        """Joints, wrenches, forces, places."""
        out, t = self._out, tick.time_ns
        out.sample(
            t,
            np.concatenate([tick.q, tick.q_holder]),
            np.concatenate([tick.dq, tick.dq_holder]),
            np.concatenate([tick.tau, tick.tau_holder]),
        )
        out.signal("commanded_wrench", t, tick.commanded, "N, N m")
        out.signal("estimated_wrench", t, tick.estimated, "N, N m")
        out.signal("estimated_wrench_std", t, tick.estimated_std, "N, N m")
        out.signal("wanted_force", t, tick.wanted_force, "N")
        out.signal("normal_force", t, tick.normal_force, "N")
        out.signal("true_force", t, tick.true_force, "N")
        out.signal("true_normal_force", t, tick.true_normal, "N")
        out.signal("tool_position", t, tick.T_world_tool[:3, 3], "m")
        out.signal("board_position", t, tick.T_world_board[:3, 3], "m")
        if tick.T_world_board_seen is not None:
            out.signal("board_position_seen", t, tick.T_world_board_seen[:3, 3], "m")
        out.signal("pass_number", t, float(tick.number))
        out.signal("stroke", t, float(tick.stroke))
        out.signal("yielding", t, float(tick.yielding))
        out.signal("held", t, float(tick.held))
        where = (tick.task, tick.phase)
        if where != self._where:
            out.event(t, "phase", " ".join(w for w in where if w))
            self._where = where

    def look(self, look: Look) -> None:
        """The picture and what was seen."""
        seen = "no board" if look.sight.board is None else "dirty" if look.sight.dirty else "clean"
        self._out.event(look.time_ns, "look", f"{look.why}: {seen}")
        if self.remark:
            return
        jpeg = cv2.imencode(".jpg", look.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        try:
            self._out.add(
                "/camera/image/compressed",
                "sensor_msgs/msg/CompressedImage",
                look.time_ns,
                {"format": "jpeg", "data": jpeg},
            )
        except MissingExtraError as error:
            self.remark = f"pictures are not in the recording: {error}"

    def event(self, event: Event) -> None:
        """What happened."""
        self._out.event(event.time_ns, event.kind, event.text)
