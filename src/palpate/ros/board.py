"""The whiteboard's nodes: a simulated arm that wipes by what its camera sees, and a camera that judges boards.

Pictures are ``sensor_msgs/msg/CompressedImage`` (JPEG), so any camera's will do for the second node.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, suggest
from .messages import (
    CompressedImage,
    Float64,
    Header,
    JointState,
    String,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)
from .source import OneWriter
from .tasks import TaskNode
from .transport import LATCHED, SENSOR_DATA

if TYPE_CHECKING:
    from ..wipe import Event, JobResult, Look, Tick

_LARGEST_PICTURE = 4096
"""[kB]"""
_QUALITY = 85
"""of a JPEG"""
_START_NS = 1_000_000_000
"""stamp of the beginning: 0 means no stamp in ROS [ns]"""
_WISHES = ("pause", "resume", "stop")


class _AbandonedError(Exception):
    """The process is to end in the middle of a job."""


class _BoardNode(TaskNode):
    """A node about a board, whose arm is none of its parameters."""

    largest = _LARGEST_PICTURE

    def _choose_arm(self) -> None:
        pass


class Wipe(_BoardNode):
    """The whole job in simulation: look at a board, hold it, wipe it, look again.

    ``image/compressed``: every picture it takes; ``wipe_state``: what it does; ``joint_states`` and ``eraser_wrench``
    (of the board on the felt, by the joint torques; NaN where it is not to be believed) of the wiping arm;
    ``ink_left``: part of the ink that is left, which only a simulation knows; ``verdict``: clean, dirty or stopped,
    at the end. On ``command`` it takes the words pause, resume and stop.
    """

    task = "wipe"
    about = "a simulated arm that wipes a whiteboard by what its camera sees: image/compressed, wipe_state, verdict out"
    simulated = True

    def _prepare(self) -> None:
        from ..wipe import BoardScene, JobOptions, WipeJob, random_board

        declare, usual = self._declare, JobOptions()
        board = declare("board", 1, "number of the board that is drawn by chance", fixed=True)
        self._pace = declare("pace", 1.0, "simulated seconds per second; 0: as fast as it goes", fixed=True)
        rate = declare("rate", 50.0, "joint_states and eraser_wrench per simulated second [Hz]", fixed=True)
        if not 0.0 < rate <= 500.0:
            raise InputError(f"rate must be above 0 and at most 500 Hz, got {rate!r}")
        if not 0.0 <= self._pace < math.inf:
            raise InputError(f"pace must be a number >= 0, got {self._pace!r}")
        options = JobOptions(
            speed=declare("speed", usual.speed, "of the eraser on the board [m/s]", fixed=True),
            normal_force=declare("normal_force", usual.normal_force, "that presses it on [N]", fixed=True),
            passes=declare("passes", usual.passes, "at most", fixed=True),
            hold=declare(
                "hold", usual.hold, "the other arm takes the board: always, needed, never", fixed=True
            ),
        )
        self._every_ns = round(1e9 / rate)
        self.job = WipeJob(BoardScene(*random_board(board)), options)
        self._ink = self.job.scene.ink.area
        self._image = self.publish(CompressedImage, "image/compressed", LATCHED)
        self._state = self.publish(String, "wipe_state", LATCHED)
        self._verdict = self.publish(String, "verdict", LATCHED)
        self._left = self.publish(Float64, "ink_left", LATCHED)
        self._joints = self.publish(JointState, "joint_states")
        self._wrench = self.publish(WrenchStamped, "eraser_wrench")
        self.subscribe(String, "command", self._take, optional=True)
        self._doing, self._next_ns, self._again = "", 0, False

    def _take(self, message: String, _: int) -> None:
        wrong = message.data not in _WISHES
        self.trouble(
            "command",
            f"no command {message.data[:40]!r}; {suggest(message.data[:40], _WISHES)}" if wrong else "",
        )
        if not wrong:
            self._again = message.data == "resume"
            getattr(self.job, message.data)()

    def work(self) -> None:
        """The job from its beginning, or from where it was stopped, to its end."""
        self._perform(lambda: False)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """See :meth:`TaskNode.run`. A job that was stopped on a ``command`` goes on when told to resume."""
        result = self._perform(stop)
        while result is not None and result.resumable and not stop():
            self.spin_once()
            if self._again:
                result = self._perform(stop)
        self.finished = result is not None and not stop()

    def _perform(self, stop: Callable[[], bool]) -> JobResult | None:
        """Until the job ends; None: `stop()` said so, and the simulated arms are left where they are."""
        from ..wipe import Observer

        node, begun = self, time.monotonic()
        self._again = False
        start_ns = self.job.scene.time_ns

        class Teller(Observer):
            def tick(self, tick: Tick) -> None:
                if stop():
                    raise _AbandonedError
                node.tell(tick)
                rest = 0.0
                if node._pace:
                    simulated = 1e-9 * (node.job.scene.time_ns - start_ns)
                    rest = max(simulated / node._pace - (time.monotonic() - begun), 0.0)
                node.spin_once(rest)

            def look(self, look: Look) -> None:
                node.show(look)

            def event(self, event: Event) -> None:
                if event.kind != "activity":
                    node.log(event.text)

        try:
            result = self.job.run(observer=Teller())
        except _AbandonedError:
            return None
        self._enter("ended")
        self._verdict.publish(String(result.verdict))
        self._left.publish(Float64(result.ink_left))
        self.fact("verdict", f"{result.verdict} {result.reason}".strip())
        return result

    def tell(self, tick: Tick) -> None:
        """Publish what the arm does, at its rate."""
        self._enter(tick.task)
        if tick.time_ns < self._next_ns:
            return
        self._next_ns = tick.time_ns - tick.time_ns % self._every_ns + self._every_ns
        arm = self.job.scene.arms[0]
        header = Header(Time.of(tick.time_ns + _START_NS), arm.base)
        self._joints.publish(
            JointState(header, arm.joint_names, tick.q.tolist(), tick.dq.tolist(), tick.tau.tolist())
        )
        force, moment = Vector3(*tick.estimated[:3].tolist()), Vector3(*tick.estimated[3:].tolist())
        self._wrench.publish(WrenchStamped(header, Wrench(force, moment)))

    def show(self, look: Look) -> None:
        """Publish a picture."""
        import cv2

        jpeg = cv2.imencode(".jpg", look.image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        header = Header(Time.of(look.time_ns + _START_NS), "camera")
        self._image.publish(CompressedImage(header, "bgr8; jpeg compressed bgr8", jpeg))
        self._left.publish(Float64(self.job.scene.ink.area / self._ink if self._ink > 0.0 else math.nan))

    def _enter(self, task: str) -> None:
        if task != self._doing:
            self._doing = task
            self._state.publish(String(task))


class Camera(_BoardNode):
    """What is on the board in every picture of ``image/compressed``.

    ``ink``: part of the board's surface under ink, NaN where no board is seen; ``board``: clean, dirty or none;
    ``corners``: outline of the best board as a JSON list of pixels.
    """

    task = "camera"
    about = "whether the board in a camera's pictures is dirty: image/compressed in, ink and board out"

    def _prepare(self) -> None:
        from ..vision import METHODS

        method = self._declare("method", "lines", f"how a board is looked for: {', '.join(METHODS)}")
        self._consider({"method": method})
        self._ink = self.publish(Float64, "ink", LATCHED)
        self._board = self.publish(String, "board", LATCHED)
        self._corners = self.publish(String, "corners", LATCHED)
        latched = self._declare(
            "latched",
            True,
            "pictures come seldom and are kept, as by wipe; false: a stream of a camera",
            fixed=True,
        )
        pictures = self.subscribe(
            CompressedImage, "image/compressed", self._take, LATCHED if latched else SENSOR_DATA
        )
        self._one = OneWriter(self, pictures)

    def _consider(self, values: Mapping[str, Any]) -> None:
        from ..vision import METHODS

        if values["method"] not in METHODS:
            raise InputError(f"no method {values['method']!r}; {suggest(values['method'], METHODS)}")

    def _take(self, message: CompressedImage, writer: int) -> None:
        from ..vision import see

        if not self._one.accept(writer):
            return
        image = _decoded(bytes(message.data))
        self.trouble(
            "image", "" if image is not None else f"image: {message.format[:40]!r} cannot be decoded"
        )
        if image is None:
            return
        try:
            sight = see(image, method=self.parameters["method"])
        except InputError as error:
            self.trouble("image", str(error))
            return
        word = "none" if sight.dirty is None else "dirty" if sight.dirty else "clean"
        board = sight.board
        self._ink.publish(Float64(sight.covered))
        self._board.publish(String(word))
        self._corners.publish(String("[]" if board is None else str(np.round(board.corners, 1).tolist())))
        self.fact("board", word)
        self.fact("ink", f"{sight.covered:.6f}")


def _decoded(data: bytes) -> Any:
    """The picture (H, W, 3) BGR; None: these bytes are none."""
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:  # absurd sizes in its header
        return None
