"""The slow activities: perception and navigation. They answer one question at a time."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
import shapely

from .. import vision
from ..arm import Array
from .activity import Activity, Slot
from .fast import Work
from .motion import Path, find
from .options import JobOptions
from .reach import inverse_kinematics, paced, reachable, tool_poses
from .result import Look
from .scene import FRAME, THICK, BoardScene
from .strokes import Eraser, Motion, Plan, plan, shape

Question = TypeVar("Question")
Answer = TypeVar("Answer")

ABOVE = 0.06
"""height to which a tool is taken up before it goes away [m]"""
MARGIN = 0.008
"""wiped around what is seen to be dirty: the eye may be off by 4 mm, the tool by as much [m]"""
BACK = 0.08
"""way of the gripper's fingers towards the rim [m]"""


FRAMES = 5
"""pictures of which the mean is looked at"""
FAINT, CLEAR = 0.012, 0.02
"""part of the light that the weakest and the core of what is left of ink take away, at least: a twentieth of a layer of
ink takes 0.04, half of it where it is no wider than a pixel"""
REST_FAINT, REST_CLEAR, REST = 0.010, 0.015, 6
"""the same where ink was, and pixels of a rest at least: elsewhere so small and pale a speck is the surface's own"""
WAS = 0.004
"""where ink was, and so far beside it [m]"""
DUSTY = 2.0
"""specks where ink was are rests if there are so many times as many as on as much of the surface beside it"""
FREE = 0.003
"""a hand about to take the board keeps so far from everything [m]"""
MARGINS = (0.4, 0.05)
"""of the arm's joints from their limits: what is good, and what will do [rad]"""
DRAG, FARTHEST = 0.03, 10
"""the board is brought by so many steps of so much at most [m]"""
STEEP = 0.33
"""largest inclination of the fingers against the board with which the gripper takes it [rad]"""
TURN = 0.6
"""no joint turns further on such a short way, or the hand would leave it [rad]"""


class Slow(Activity, Generic[Question, Answer]):
    """Answers questions; in a thread of its own where it must not keep the fast ones waiting."""

    def __init__(self, name: str, period_ns: int, threaded: bool) -> None:
        super().__init__(name, period_ns)
        self.question: Slot[Question] = Slot()
        self.answer: Slot[Answer] = Slot()
        self._pool = ThreadPoolExecutor(1, name) if threaded else None
        self._coming: Future[Answer] | None = None

    def step(self, time_ns: int) -> None:
        """Take a question, think, answer."""
        if self._coming is not None:
            if not self._coming.done():
                return
            self.answer.put(self._coming.result())
            self._coming = None
        if self.state != "running":
            return
        question = self.ready()
        if question is None:
            return
        think = self.thinking(time_ns, question)
        if self._pool is None:
            self.answer.put(think())
        else:
            self._coming = self._pool.submit(think)

    def ready(self) -> Question | None:
        """A question for which everything is there."""
        return self.question.take()

    @abstractmethod
    def thinking(self, time_ns: int, question: Question) -> Callable[[], Answer]:
        """Begin in the thread of the fast ones; what takes long is what is returned."""

    def clean(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)


class Perception(Slow[str, Look]):
    """Takes pictures and looks for the board and the ink; the question is what they are for.

    With the arms out of the way (before, after) it takes FRAMES of them, one in each cycle, and looks at their mean;
    after wiping for whatever ink could be told from the surface. A check is one picture.
    """

    def __init__(self, scene: BoardScene, period_ns: int, threaded: bool) -> None:
        super().__init__("perception", period_ns, threaded)
        self._scene = scene
        self._camera = scene.camera
        self._why: str | None = None
        self._frames: list[npt.NDArray[np.uint8]] = []
        self._was = shapely.Polygon()
        """where ink was seen (board coordinates)"""

    def ready(self) -> str | None:
        """A picture in each cycle, until there are enough for what they are for."""
        question = self.question.take()
        if question is not None:
            self._why, self._frames = question, []
        if self._why is None:
            return None
        self._frames.append(self._scene.look())
        if self._why != "check" and len(self._frames) < FRAMES:
            return None
        why, self._why = self._why, None
        return why

    def thinking(self, time_ns: int, question: str) -> Callable[[], Look]:
        """What is in the pictures, later."""
        frames, size = self._frames, self._scene.ink.size

        def see() -> Look:
            image, moved = vision.average(frames)
            sight = vision.see(image, size=size, camera=self._camera)
            if sight.board is not None and moved[_within(sight.board.corners, moved.shape)].any():
                image = frames[-1]  # somebody is in front of the board: noise, but no ghosts
                sight = vision.see(image, size=size, camera=self._camera)
            if question == "after" and sight.board is not None:
                sight = self._rests(image, sight, sight.board.corners)
            if question != "check":
                ink = [shape(p, "ink") for p in sight.ink_polygons]
                self._was = shapely.union_all([self._was, *ink])
            return Look(time_ns, image, sight, question)

        return see

    def _rests(self, image: npt.NDArray[np.uint8], sight: vision.Sight, corners: Array) -> vision.Sight:
        """With the ink that is left after wiping."""
        sure = vision.ink(image, corners, faint=FAINT, clear=CLEAR)
        specks = vision.ink(image, corners, faint=REST_FAINT, clear=REST_CLEAR, least=REST)
        was, mask = self._was.buffer(WAS), sure.mask.copy()
        rests, elsewhere = [], 0
        for k, place in enumerate(replace(sight, ink=specks).ink_polygons):
            drawn = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(drawn, [np.rint(specks.polygons[k]).astype(np.int32)], 1)
            piece = drawn > 0
            if sure.mask[piece].any():
                continue
            if shape(place, "ink").within(was):
                rests.append((k, piece & specks.mask))
            else:
                elsewhere += 1
        width, height = self._scene.ink.size
        if len(rests) <= DUSTY * elsewhere * was.area / max(width * height - was.area, was.area):
            rests = []  # as many as the surface has by itself
        for _, piece in rests:
            mask |= piece
        polygons = *sure.polygons, *(specks.polygons[k] for k, _ in rests)
        contrast = *sure.contrast, *(specks.contrast[k] for k, _ in rests)
        return replace(sight, ink=vision.Ink(mask, polygons, sure.objects, np.array(contrast)))


def _within(corners: Array, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 1)
    return mask > 0


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """Where everything is, for planning."""

    q: tuple[Array, Array]
    T_base_board: Array
    """in the eraser's base, as seen"""


@dataclass(frozen=True, slots=True, eq=False)
class ToStrokes:
    """How to wipe what is dirty, and how to get there?"""

    now: Situation
    wipe: tuple[npt.NDArray[np.float64], ...]
    keep: tuple[npt.NDArray[np.float64], ...]


@dataclass(frozen=True, slots=True, eq=False)
class ToGrip:
    """How does the other arm take the board, so that it can bring what is dirty into the eraser's reach if need be?"""

    now: Situation
    wipe: tuple[npt.NDArray[np.float64], ...]
    keep: tuple[npt.NDArray[np.float64], ...]


@dataclass(frozen=True, slots=True, eq=False)
class ToBring:
    """How does the other arm, which holds the board, bring it to where all that is dirty is in the eraser's reach?"""

    now: Situation
    wipe: tuple[npt.NDArray[np.float64], ...]
    keep: tuple[npt.NDArray[np.float64], ...]


@dataclass(frozen=True, slots=True, eq=False)
class ToPark:
    """How does an arm get out of the way?"""

    now: Situation
    arm: int


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """An answer; with a reason and no path: it cannot be done."""

    paths: tuple[Path, ...] = ()
    """one after the other"""
    reason: str = ""
    plan: Plan | None = None
    work: Work | None = None
    away: float = 0.0
    """by which the board is taken away from the eraser's base, < 0: towards it [m]"""


class Navigation(Slow["ToStrokes | ToGrip | ToBring | ToPark", Route]):
    """Strokes, grasps and ways for both arms."""

    def __init__(
        self,
        scene: BoardScene,
        period_ns: int,
        threaded: bool,
        options: JobOptions,
        home: tuple[Array, Array],
    ) -> None:
        super().__init__("navigation", period_ns, threaded)
        self._scene, self._options, self._home = scene, options, home
        self._motion: Motion = options.motions
        self._eraser: Eraser = replace(scene.eraser, rub=options.rub)

    def thinking(self, time_ns: int, question: ToStrokes | ToGrip | ToBring | ToPark) -> Callable[[], Route]:
        """All of it later."""
        if isinstance(question, ToStrokes):
            return lambda: self._strokes(question)
        if isinstance(question, ToGrip):
            return lambda: self._grip(question)
        if isinstance(question, ToBring):
            return lambda: self._bring(question)
        return lambda: self._park(question.now, question.arm)

    def _strokes(self, question: ToStrokes) -> Route:
        """The better way to lay the eraser first; the other one if the arm does not get everywhere."""
        refused: Route | None = None
        turned: bool | None = None
        for turned in (None, True, False):
            if refused is not None and refused.plan is not None and refused.plan.turned is turned:
                continue
            route = self._laid(question, turned)
            if not route.reason:
                return route
            refused = refused or route
        assert refused is not None
        return refused

    def _laid(self, question: ToStrokes, turned: bool | None) -> Route:
        now, size = question.now, self._scene.ink.size
        arm = self._scene.arms[0]

        def made(start: Array | None, turned: bool | None) -> Plan:
            return plan(
                question.wipe,
                size,
                keep=question.keep,
                eraser=self._eraser,
                motion=self._motion,
                start=start,
                turned=turned,
                margin=MARGIN,
            )

        strokes = made(None, turned)
        if not strokes.strokes:
            return Route(plan=strokes)
        # the arm goes to the first stroke through the air, by its joints
        strokes = made(strokes.strokes[0][0], strokes.turned)
        for margin in MARGINS:
            reach = reachable(arm, strokes, now.T_base_board, margin=margin)
            if reach.ok:
                break
        if not reach.ok:
            return Route(reason=f"the board is out of reach: {reach.reason}", plan=strokes)
        path = self._way(0, now, reach.q[0])
        if path is None:
            return Route(reason="there is no clear way for the arm to the board", plan=strokes)
        o = self._options
        legs = paced(
            arm,
            strokes,
            reach,
            now.T_base_board,
            max_force=o.max_force,
            max_torque=o.max_torque,
            normal_force=o.normal_force,
        )
        number = itertools.accumulate(leg.phase == "touch" for leg in legs)
        work = Work(
            legs,
            tuple(max(0, k - 1) for k in number),
            now.T_base_board,
            strokes.angle + reach.turn,
            size,
            self._motion,
        )
        return Route((path,), plan=strokes, work=work)

    def _grip(self, question: ToGrip) -> Route:
        """By a rim that is not the eraser's side, fingers a little inclined so that the hand stays off the table.

        More, where the board is out of the eraser's reach: the hand that drags it goes over the table.
        """
        now = question.now
        far = bool(self._strokes(ToStrokes(now, question.wipe, question.keep)).reason)
        arm, (W, H) = self._scene.arms[1], self._scene.ink.size
        T = self._scene.T_holder_base @ now.T_base_board
        out, clearance = np.array([0.0, 0.0, 1.0]), self._clearance(1, now)
        rims = [((a * W, -FRAME), (0.0, 1.0)) for a in (0.5, 0.3, 0.7)]
        rims += [((W + FRAME, 0.3 * H), (-1.0, 0.0)), ((-FRAME, 0.3 * H), (1.0, 0.0))]
        inclines = (STEEP, 0.3, 0.15, 0.0) if far else (0.15, 0.3, 0.0)
        ways = list(itertools.product(rims, inclines, (1.0, -1.0)))
        if far:
            ways.sort(key=lambda w: -w[1])
        for (at, inward), incline, side in ways:
            c, s = math.cos(incline), math.sin(incline)
            d = np.array([*inward, 0.0])
            z, y = c * d + s * out, side * (c * out - s * d)
            grasp = np.eye(4)
            grasp[:3, :3] = np.stack((np.cross(y, z), y, z), axis=1)
            grasp[:3, 3] = *at, 0.5 * THICK
            before = grasp.copy()
            before[:3, 3] -= BACK * z
            q = inverse_kinematics(arm, T @ before, q=now.q[1])
            goal = None if q is None else inverse_kinematics(arm, T @ grasp, q=q)
            if q is None or goal is None or float(np.abs(goal - q).max()) > TURN:
                continue
            if clearance(q) < FREE or clearance(goal) < -FREE:
                continue  # the hand would be in the table; its fingers are about the rim
            path = self._way(1, now, q)
            if path is not None:
                return Route((path, Path((q, goal), 0.2)))
        return Route(reason="the other arm cannot take the board: no grasp of its rim is in reach")

    def _bring(self, question: ToBring) -> Route:
        """Along the table towards the eraser's arm or away from it, as little as will do."""
        now = question.now
        T = now.T_base_board
        W, H = self._scene.ink.size
        middle = T[:3, :3] @ [0.5 * W, 0.5 * H, 0.0] + T[:3, 3]
        way = middle - T[:3, 2] * (T[:3, 2] @ middle)
        way /= np.linalg.norm(way)
        for k, sign in itertools.product(range(1, FARTHEST + 1), (-1.0, 1.0)):
            away = sign * k * DRAG
            there = T.copy()
            there[:3, 3] += away * way
            if not self._scene.stands(there):
                continue
            if self._strokes(ToStrokes(Situation(now.q, there), question.wipe, question.keep)).reason:
                continue
            path = self._drag(now, away * way)
            if path is not None:
                return Route((path,), away=away)
        return Route(reason="there is no place on the table to which the other arm can bring it")

    def _drag(self, now: Situation, way: Array) -> Path | None:
        """Of the other arm with the board in its hand, straight."""
        arm, aside = self._scene.arms[1], now.T_base_board.copy()
        aside[:3, 3] += [0.0, 0.0, 10.0]  # the board goes with the hand: nothing to keep clear of
        hand = arm.forward_kinematics(now.q[1])
        hand[:3, 3] += hand[:3, :3] @ arm.grasp
        count = math.ceil(float(np.linalg.norm(way)) / DRAG)
        poses = [now.q[1]]
        for _ in range(count):
            hand[:3, 3] += self._scene.T_holder_base[:3, :3] @ way / count
            q = inverse_kinematics(arm, hand, q=poses[-1])
            if q is None or float(np.abs(q - poses[-1]).max()) > TURN:
                return None
            if self._scene.clearance(1, q, now.q[0], aside) < 0.0:
                return None
            poses.append(q)
        return Path(tuple(poses), 0.2)

    def _park(self, now: Situation, which: int) -> Route:
        q, home = now.q[which], self._home[which]
        arm = self._scene.arms[which]
        T = arm.forward_kinematics(q)
        T[:3, 3] += T[:3, :3] @ arm.grasp
        T_board = now.T_base_board if which == 0 else self._scene.T_holder_base @ now.T_base_board
        start: list[Path] = []
        if which == 0 and float(T_board[:3, 2] @ (T_board[:3, 3] - T[:3, 3])) < ABOVE:
            up = T.copy()
            up[:3, 3] -= ABOVE * T_board[:3, 2]
            above = inverse_kinematics(arm, up, q=q)
            if above is not None and float(np.abs(above - q).max()) < TURN:
                start, q = [Path((q, above), 0.4)], above
        elif which == 1:
            back = T.copy()
            back[:3, 3] -= BACK * T[:3, 2]
            away = inverse_kinematics(arm, back, q=q)
            if away is not None and float(np.abs(away - q).max()) < TURN:
                start, q = [Path((q, away), 0.4)], away
        path = find(q, home, self._via(which, now, q), self._clearance(which, now))
        if path is None:
            return Route(tuple(start), "there is no clear way for an arm to where it rests")
        return Route((*start, path))

    def _way(self, which: int, now: Situation, goal: Array) -> Path | None:
        return find(now.q[which], goal, self._via(which, now, goal), self._clearance(which, now))

    def _clearance(self, which: int, now: Situation) -> Callable[[Array], float]:
        other = now.q[1 - which]
        return lambda q: self._scene.clearance(which, q, other, now.T_base_board)

    def _via(self, which: int, now: Situation, near: Array) -> list[Array]:
        """Where it rests, and high above the board in the posture of `near`."""
        if which == 1:
            return [self._home[1]]
        W, H = self._scene.ink.size
        high = tool_poses(np.array([[0.5 * W, 0.5 * H, 0.2]]), now.T_base_board, 0.0)[0]
        q = inverse_kinematics(self._scene.arms[0], high, q=near)
        return [self._home[0], *([] if q is None else [q])]
