"""The mediator: which activity does what next, and what is done when something goes wrong."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import shapely
from statemachine import State, StateMachine

from .. import vision
from .._core import AbagParameters, CartesianVelocityOptions, Posture
from ..arm import Arm, Array
from ..control import CartesianVelocity
from .activity import Activity, Slot
from .choice import Choice, choose, ink_colours
from .fast import Control, Estimation, Follow, Hold, Law, Robot, Wipe
from .motion import Path
from .options import JobOptions
from .result import Kind, Look, Verdict
from .slow import Navigation, Perception, Route, Situation, ToBring, ToGrip, ToPark, ToStrokes
from .strokes import Plan, outlines, shape, swept

SURE = 0.8
"""confidence of a board from which its place is believed"""
LOOKS = 3
"""pictures taken before no board is given up"""
MOVED = 0.008
"""a board that is seen so far from where it was has moved [m]"""
SLIPPED = 0.002
"""the hand that holds the board has moved by so much [m]"""
PATCH, SEARCH = 16, 100
"""half sides of what a corner looks like, and of where it is sought [pixel]"""
SAME = 0.012
"""two corners that went the same way differ in it by so much at most [m]"""
LIKE = 0.75
"""correlation from which a corner is found"""
SHAPE = 2.0
"""corners of a board found are so far at most from those of the nearest pose of a board of the right size [pixel]"""
PATIENCE_NS = 2_000_000_000
"""for a torque channel to come back [ns]"""
LEFT = 0.005
"""part of the ink's area that may be left on a clean board"""
SAME_PLACE = 0.004
"""rests lie so near the ink they are left of [m]"""
STAIN, STAYS = 0.06, 0.8
"""a mark that takes away less than this part of the light, and so much of it after the eraser was there, is no ink"""
NEAR = "what is left is too near to something that is to be left alone, or to a corner of the board"
"""why it ends dirty before the passes are used up"""
CALM_NS = 400_000_000
"""at rest after a fault before anything moves; a channel must be well for so long [ns]"""

# what moves a heavy arm well with 5 N; see docs/wiping.md
GAINS: Mapping[str, Any] = {
    "abag": AbagParameters(
        alpha=0.5,
        theta_b=0.0,
        delta_b=0.003,
        theta_g=0.5,
        delta_g=0.008,
        period=0.004,
        band=0.05,
        least_gain=0.6,
    ),
    "abag_turning": AbagParameters(
        alpha=0.5,
        theta_b=0.0,
        delta_b=8e-4,
        theta_g=1.0,
        delta_g=0.008,
        period=0.004,
        band=0.15,
        least_gain=0.6,
    ),
    "turning": 8.0,
    "approach": 5.0,
    # the elbow drifts; a joint at its limit of speed would be braked, and the tool with it
    "posture": Posture(damping=4.0, largest=3.0),
}

Cause: TypeAlias = Literal["", "torque", "contact", "hand", "other"]


class Mission(StateMachine):
    """What the job does now; every way between two of these is one of the events."""

    parking = State(initial=True)
    looking = State()
    holding = State()
    planning = State()
    bringing = State()
    moving = State()
    wiping = State()
    safe = State()
    releasing = State()
    ended = State(final=True)

    look = parking.to(looking) | holding.to(looking) | bringing.to(looking)
    hold = looking.to(holding) | planning.to(holding)
    bring = planning.to(bringing)
    think = looking.to(planning) | holding.to(planning)
    move = planning.to(moving)
    wipe = moving.to(wiping) | safe.to(wiping)
    park = wiping.to(parking) | safe.to(parking) | moving.to(parking)
    fail = (
        parking.to(safe)
        | looking.to(safe)
        | holding.to(safe)
        | planning.to(safe)
        | bringing.to(safe)
        | moving.to(safe)
        | wiping.to(safe)
    )
    release = looking.to(releasing) | planning.to(releasing) | bringing.to(releasing)
    end = (
        looking.to(ended)
        | planning.to(ended)
        | holding.to(ended)
        | bringing.to(ended)
        | safe.to(ended)
        | releasing.to(ended)
        | parking.to(ended)
    )


@dataclass(slots=True, eq=False)
class Memory:
    """What a job knows of its board, however often it is stopped and goes on."""

    number: int = 0
    """passes that were begun"""
    broken: bool = False
    """the last one was broken off in its middle"""
    first: Choice | None = None
    """what was to be wiped, and what was to stay, before the first pass"""
    marks: list[tuple[Any, float]] = field(default_factory=list)
    """ink as it was seen before the last pass (shapely, board coordinates), and how much light its core took away"""
    wiped: Any = None
    """where the eraser has been (shapely, board coordinates)"""
    left: Any = None
    """what the last pass's strokes could not wipe (shapely)"""
    stains: list[Any] = field(default_factory=list)
    """marks that do not come off (shapely)"""


@dataclass(frozen=True, slots=True, eq=False)
class Others:
    """The activities that the mediator tells what to do, and what it knows of the cell."""

    arms: tuple[Arm, Arm]
    robot: Robot
    estimation: Estimation
    control: Control
    perception: Perception
    navigation: Navigation
    nominal: Array
    """(4, 4) where boards usually lie, in the eraser's base [m]"""
    camera: vision.Camera
    size: tuple[float, float]
    """of the board [m]"""

    def outline(self, T_base_board: Array) -> Array:
        """(4, 2) where the camera sees the corners of a board [pixels]."""
        W, H = self.size
        corners = np.array([[0.0, 0.0, 0.0, 1.0], [W, 0.0, 0.0, 1.0], [W, H, 0.0, 1.0], [0.0, H, 0.0, 1.0]])
        assert self.camera.T_base_camera is not None
        lens = np.linalg.inv(self.camera.T_base_camera) @ T_base_board
        return self.camera.project((corners @ lens.T)[:, :3])

    def believable(self, look: Look) -> bool:
        """The best board in a picture is surely a board, and of the right shape."""
        board, plane = look.sight.board, look.sight.plane
        if board is None or plane is None or plane.T_base_board is None or board.confidence < SURE:
            return False
        return float(np.linalg.norm(board.corners - self.outline(plane.T_base_board), axis=1).max()) < SHAPE


def displacement(reference: Look, now: Look) -> float | None:
    """How far a board has moved between two pictures, an arm in front of the second [m]; None: too much is hidden.

    What the corners looked like is sought nearby, by normalised correlation, so that light does not matter. Corners
    that are hidden are not found; two that went the same way tell.
    """
    board, plane = reference.sight.board, reference.sight.plane
    assert board is not None and plane is not None
    first, second = (cv2.cvtColor(x.image, cv2.COLOR_BGR2GRAY) for x in (reference, now))
    height, width = first.shape
    ways = []
    for corner in board.corners:
        u, v = np.rint(corner).astype(int)
        a, b = PATCH, PATCH + SEARCH
        if not (a <= u < width - a and a <= v < height - a):
            continue
        patch = first[v - a : v + a + 1, u - a : u + a + 1]
        left, top = max(0, u - b), max(0, v - b)
        found = cv2.matchTemplate(second[top : v + b + 1, left : u + b + 1], patch, cv2.TM_CCOEFF_NORMED)
        _, best, _, at = cv2.minMaxLoc(found)
        if best > LIKE:
            shift = np.array([at[0] + left - u + a, at[1] + top - v + a])
            ways.append(plane.to_board(corner + shift) - plane.to_board(corner))
    for p, q in itertools.combinations(ways, 2):
        if float(np.linalg.norm(p - q)) < SAME:
            return float(min(np.linalg.norm(p), np.linalg.norm(q)))
    return None


def _marks(count: int) -> str:
    if not count:
        return ""
    marks = "a faint mark that does" if count == 1 else f"{count} faint marks that do"
    return f"but for {marks} not come off, taken for the surface's own"


def _area(polygons: Iterable[Array]) -> float:
    return float(shapely.union_all([shape(p, "ink") for p in polygons]).area)


class Mediator(Activity):
    """Sees to it that a board gets clean.

    Args:
        period_ns: of its cycles [ns].
        options: of the job.
        others: the activities it tells what to do.
        tell: called with what happened.
        passed: called when a pass has begun, is halted, goes on or is done.
        memory: of what was done before; it is kept up to date.
    """

    def __init__(
        self,
        period_ns: int,
        options: JobOptions,
        others: Others,
        tell: Callable[[Kind, str], None],
        passed: Callable[[str, Plan | None, float], None],
        memory: Memory,
    ) -> None:
        super().__init__("mediator", period_ns)
        self.mission = Mission()
        self.task = "parking"
        self.verdict: Verdict = "stopped"
        self.reason = ""
        self.resumable = False
        self.memory = memory
        self.T_base_board: Array | None = None
        self.looks: list[Look] = []
        self.wipe: Wipe | None = None
        self._options, self._others, self._tell, self._passed = options, others, tell, passed
        self._fault: Slot[str] = Slot()
        self._cause: Cause = ""
        self._since = self._well = 0
        self._now = 0
        self._asked = self._parked = False
        self._paths: deque[tuple[int, Path]] = deque()
        self._law: tuple[int, Law] | None = None
        self._tries = self._grips = self._again = self._doubts = self._brought = 0
        self._unreachable = self._refused = ""
        self._stopping = False
        self._choice: Choice | None = None
        self._route_now = Route()
        self._reference: Look
        self._hand: Array | None = None
        self._loose = True  # as far as is known the board stays where it is by itself
        self._checked = 0

    @property
    def number(self) -> int:
        """Passes that were begun."""
        return self.memory.number

    # -- from outside ----------------------------------------------------------

    def faulted(self, text: str) -> None:
        """Control cannot go on with an arm and holds it."""
        self._fault.put(text)

    def stop(self, why: str) -> None:
        """Come to a safe end."""
        if self._stopping:
            return
        self._stopping = True
        if self.task not in ("safe", "ended", "releasing"):
            self._halt("other", why)
        elif self.task == "safe":
            self._cause, self.reason = "other", why

    # -- its cycles ------------------------------------------------------------

    def step(self, time_ns: int) -> None:
        """Look after what is going on, and go on when it is done."""
        self._now = time_ns
        if self.state != "running":
            return
        fault = self._fault.take()
        if fault is not None and self.task == "wiping":
            cause: Cause = "torque" if "torque" in fault else "hand" if "pushed" in fault else "contact"
            self._halt(cause, fault)
        getattr(self, f"_{self.task}")()

    def _go(self, event: str) -> None:
        self.mission.send(event)
        self.task = str(next(iter(self.mission.configuration_values)))
        self._asked = False
        self._paths.clear()
        self._law = None
        self._parked = False
        self._since = self._now

    def _halt(self, cause: Cause, text: str) -> None:
        """Both arms hold, at once."""
        control = self._others.control
        for k in (0, 1):
            control.orders[k].put(Hold(self._others.arms[k], k))
        self._cause, self.reason = cause, text
        self._tell("person" if cause == "other" else "fault", text)
        if self.task == "wiping":
            self.memory.broken, self.memory.wiped = True, None
            self._passed("halted", None, 0.0)
        self._go("fail")

    def _finish(self, verdict: Verdict, reason: str, *, resumable: bool = False) -> None:
        self.verdict, self.reason, self.resumable = verdict, reason, resumable
        held = self._others.robot.held
        if held and verdict != "stopped" and self.task in ("looking", "planning", "bringing"):
            self._others.robot.grip.put(False)
            self._go("release")
        else:
            self._go("end")

    def _situation(self) -> Situation:
        felt = self._others.estimation.felt.newest
        assert felt is not None
        T = self.T_base_board
        return Situation(felt.q, self._others.nominal if T is None else T)

    def _route(self, question: ToStrokes | ToGrip | ToBring | ToPark) -> Route | None:
        """Ask once; the answer when it is there."""
        if not self._asked:
            self._asked = True
            self._others.navigation.answer.take()
            self._others.navigation.question.put(question)
            return None
        return self._others.navigation.answer.take()

    def _went(self) -> bool:
        """All paths have been gone along."""
        report = self._others.control.report.newest
        if self._law is not None:
            arm, law = self._law
            if report is None or report.laws[arm] is not law or not report.effects[arm].done:
                return False
            self._law = None
        if not self._paths:
            return True
        arm, path = self._paths.popleft()
        law = Follow(self._others.arms[arm], arm, path)
        self._others.control.orders[arm].put(law)
        self._law = arm, law
        return False

    # -- what it does ----------------------------------------------------------

    def _parking(self) -> None:
        if not self._parked:
            route = self._route(ToPark(self._situation(), 0))
            if route is None:
                return
            if route.reason and not route.paths:
                self._finish("stopped", route.reason, resumable=True)
                return
            self._paths.extend((0, p) for p in route.paths)
            self._parked = True
        if not self._went():
            return
        if self._cause in ("other", "torque"):
            self._finish("stopped", self.reason, resumable=True)
        else:
            self._go("look")
            self._tries = 0

    def _looking(self) -> None:
        look = self._look("before" if self.memory.first is None else "after")
        if look is None:
            return
        self.looks.append(look)
        board, plane = look.sight.board, look.sight.plane
        if board is None or plane is None or not board.complete or not self._others.believable(look):
            self._tries += 1
            if self._tries < LOOKS:
                self._asked = False
                return
            if board is not None and not board.complete:
                text = "the board is partly out of view"
            elif self.T_base_board is not None:
                text = "the board was removed: it is nowhere in view"
            else:
                text = "no board is in view"
            self._finish("stopped", text, resumable=True)
            return
        if sum(b.confidence > SURE for b in look.sight.boards) > 1:
            self._tell("board", "more than one board is in view; the best supported one is wiped")
        seen = plane.T_base_board
        assert seen is not None
        before, self.T_base_board = self.T_base_board, seen
        away = math.inf if before is None else float(np.linalg.norm(seen[:3, 3] - before[:3, 3]))
        if before is not None and away > MOVED:
            self._loose = False
            self._again += 1
            self._tell("board", f"the board has moved by {1e3 * away:.0f} mm and is found again")
            if self._again > LOOKS:
                self._finish("stopped", "the board moves again and again", resumable=True)
                return
        elif self._cause == "contact":
            text = "the eraser is lost: nothing is felt where the board is seen"
            self._finish("stopped", text, resumable=True)
            return
        self._cause = ""
        self._reference = look
        self._plan_or_end(look)

    def _plan_or_end(self, look: Look) -> None:
        o, memory = self._options, self.memory
        choice = self._choice = self._chosen(look)
        memory.first = memory.first or choice
        if not choice.wipe:
            self._finish("clean", _marks(len(memory.stains)))
        elif memory.left is not None and not memory.broken and self._near(choice.wipe, memory.left):
            self._finish("dirty", NEAR)
        elif memory.number >= o.passes and not memory.broken:
            left = _area(choice.wipe) / _area(memory.first.wipe)
            passes = f"{memory.number} {'pass' if memory.number == 1 else 'passes'}"
            if left <= LEFT:
                self._tell("board", f"after {passes} no more than {1e2 * LEFT:g} % of the ink's area is seen")
                self._finish("clean", "")
            else:
                self._finish("dirty", f"after {passes} {1e2 * left:.2g} % of the ink's area is still seen")
        elif not self._others.robot.held and (o.hold == "always" or (o.hold == "needed" and not self._loose)):
            self._go("hold")
        else:
            self._go("think")

    @staticmethod
    def _near(ink: Iterable[Array], left: Any) -> bool:
        """All of the ink is where no stroke gets to."""
        return all(left.buffer(SAME_PLACE).contains(shape(p, "ink")) for p in ink)

    def _chosen(self, look: Look) -> Choice:
        """What of the ink that is seen is to be wiped."""
        o, memory, sight = self._options, self.memory, look.sight
        assert sight.ink is not None
        pieces = [
            (shape(p, "ink"), float(c)) for p, c in zip(sight.ink_polygons, sight.ink.contrast, strict=True)
        ]
        if memory.wiped is not None:
            memory.stains += [
                p
                for p, c in pieces
                if c < STAIN
                and memory.wiped.contains(p)
                and any(c > STAYS * before and p.intersects(q) for q, before in memory.marks)
            ]
        memory.wiped = None
        memory.marks = pieces
        stained = shapely.union_all(memory.stains).buffer(SAME_PLACE) if memory.stains else None
        ink = [p for p in sight.ink_polygons if stained is None or not stained.contains(shape(p, "ink"))]
        if o.colour is None or memory.first is None:
            return choose(
                ink,
                colours=ink_colours(look.image, look.sight) if o.colour is not None else None,
                colour=o.colour,
                within=o.within,
                without=o.without,
                objects=look.sight.object_polygons,
            )
        # the colour of a rest cannot be told; its place tells what it is left of
        goes = shapely.union_all([shape(p, "ink") for p in memory.first.wipe]).buffer(SAME_PLACE)
        stays = shapely.union_all([shape(p, "ink") for p in memory.first.keep])
        rests = choose(
            [r for p in ink for r in outlines(shape(p, "ink").intersection(goes).difference(stays))],
            within=o.within,
            without=o.without,
        )
        return Choice(rests.wipe, (*memory.first.keep, *look.sight.object_polygons))

    def _look(self, why: str) -> Look | None:
        if not self._asked:
            self._asked = True
            self._others.perception.answer.take()
            self._others.perception.question.put(why)
            return None
        look = self._others.perception.answer.take()
        return look if look is not None and look.why == why else None

    def _holding(self) -> None:
        if self._law is None and not self._paths and self._hand is None:
            assert self._choice is not None
            route = self._route(ToGrip(self._situation(), self._choice.wipe, self._choice.keep))
            if route is None:
                return
            if route.reason:
                if self._loose:
                    self._refused = route.reason
                    self._tell("board", f"{route.reason}; the board stays loose")
                    self._go("think")
                else:
                    self._finish("stopped", route.reason)
                return
            self._paths.extend((1, p) for p in route.paths)
        if not self._went():
            return
        robot = self._others.robot
        if self._hand is None:
            robot.grip.put(True)
            self._hand = self._holder_hand()
            return
        if robot.held:
            self._others.control.orders[1].put(Hold(self._others.arms[1], 1))
            self._tell("board", "the other arm holds the board")
            self._go("think")
            return
        self._hand = None
        self._grips += 1
        if self._grips < LOOKS:
            self._tell("board", "the gripper closed beside the board; look again")
            self._go("look")
            self._tries = 0
        else:
            self._finish("stopped", "the gripper closes and does not get hold of the board", resumable=True)

    def _holder_hand(self) -> Array:
        felt = self._others.estimation.felt.newest
        assert felt is not None
        arm = self._others.arms[1]
        T = arm.forward_kinematics(felt.q[1])
        return T[:3, :3] @ arm.grasp + T[:3, 3]

    def _planning(self) -> None:
        assert self._choice is not None
        route = self._route(ToStrokes(self._situation(), self._choice.wipe, self._choice.keep))
        if route is None:
            return
        if route.reason:
            self._unreachable = route.reason
            if route.plan is None or not route.plan.strokes or self._brought >= LOOKS:
                self._finish("stopped", route.reason)
            elif self._others.robot.held:
                self._brought += 1
                self._go("bring")
            elif self._options.hold == "never" or self._refused:
                self._finish("stopped", f"{route.reason}; {self._refused or 'no arm may take the board'}")
            else:
                self._go("hold")
            return
        if route.work is None:
            self._finish("dirty", NEAR)
            return
        if route.plan is not None and route.plan.left:
            count = len(route.plan.left)
            places = "a place is" if count == 1 else f"{count} places are"
            self._tell("task", f"{places} out of the eraser's reach")
        memory = self.memory
        memory.number += not memory.broken  # a pass that was broken off goes on
        memory.broken = False
        if route.plan is not None:
            ways = [
                swept(a, b, route.plan.footprint)
                for s in route.plan.strokes
                for a, b in itertools.pairwise(s)
            ]
            memory.wiped = shapely.union_all(ways)
            memory.left = shapely.union_all([shape(p, "left") for p in route.plan.left])
        self._route_now = route
        self._go("move")
        self._paths.extend((0, p) for p in route.paths)

    def _bringing(self) -> None:
        """The other arm takes the board to where the eraser reaches; then it is looked at again."""
        if not self._parked:
            assert self._choice is not None
            route = self._route(ToBring(self._situation(), self._choice.wipe, self._choice.keep))
            if route is None:
                return
            if route.reason:
                self._finish("stopped", f"{self._unreachable}; {route.reason}")
                return
            self._paths.extend((1, p) for p in route.paths)
            self._parked = True
            where = "nearer to the eraser's arm" if route.away < 0.0 else "away from the eraser's arm"
            self._tell(
                "board",
                f"{self._unreachable}; the other arm brings the board {1e2 * abs(route.away):.0f} cm {where}",
            )
        if not self._went():
            return
        self._others.control.orders[1].put(Hold(self._others.arms[1], 1))
        self._hand, self.T_base_board = self._holder_hand(), None
        self._go("look")
        self._tries = 0

    def _moving(self) -> None:
        if not self._went():
            return
        route, o = self._route_now, self._options
        assert route.work is not None
        controller = CartesianVelocity(
            self._others.arms[0],
            self._others.control.period_ns * 1e-9,
            CartesianVelocityOptions(**GAINS, max_force=o.max_force, max_torque=o.max_torque),
        )
        self.wipe = Wipe(self._others.arms[0], controller, route.work, o.normal_force)
        self._go("wipe")
        self._begin_wiping()
        seen = self.looks[-1].sight.covered
        self._passed("begun", route.plan, seen)
        strokes = "" if route.plan is None else f"{route.plan.summary}, "
        self._tell("task", f"pass {self.number}: {strokes}about {self.wipe.total:.0f} s")

    def _begin_wiping(self) -> None:
        assert self.wipe is not None
        self._others.control.orders[0].put(self.wipe)
        self._checked = self._now

    def _wiping(self) -> None:
        report = self._others.control.report.newest
        if report is not None and report.laws[0] is self.wipe and report.effects[0].done:
            self._passed("done", None, 0.0)
            self._go("park")
            return
        if self._hand is not None:
            if not self._others.robot.held:
                self._hand = None
                self._halt("hand", "the board slipped out of the other arm's hand")
                return
            away = float(np.linalg.norm(self._holder_hand() - self._hand))
            if away > SLIPPED:
                self._halt("hand", f"the hand that holds the board was pushed away by {1e3 * away:.1f} mm")
                self._hand = self._holder_hand()
        elif self._options.look_every > 0.0:
            self._check()

    def _check(self) -> None:
        """Is the board still where it was? The arm may hide a part of it."""
        if not self._asked:
            if self._now - self._checked < self._options.look_every * 1e9:
                return
            self._checked = self._now
        look = self._look("check")
        if look is None:
            return
        self._asked = False
        away = displacement(self._reference, look)
        if away is not None and away > MOVED:
            self._halt("hand", f"the board moved by {1e3 * away:.0f} mm under the eraser")
            self._loose = False
        elif away is None and self._doubts < LOOKS:
            self._doubts += 1
            self._halt("hand", "too little of the board is seen where it was")

    def _safe(self) -> None:
        waited = self._now - self._since
        if self._cause == "torque":
            felt = self._others.estimation.felt.newest
            well = felt is not None and felt.believed
            self._well = (self._well or self._now) if well else 0
            if self._well and self._now - self._well >= CALM_NS and self.wipe is not None:
                self._tell("task", "the torque channel is back: it goes on where it was")
                self.wipe.resume()
                self._well = 0
                self._cause = ""
                self.memory.broken = False
                self._go("wipe")
                self._passed("resumed", None, 0.0)
                self._begin_wiping()
                return
            if waited < PATIENCE_NS:
                return
        if waited >= CALM_NS:
            self._go("park")

    def _releasing(self) -> None:
        if not self._parked:
            route = self._route(ToPark(self._situation(), 1))
            if route is None:
                return
            self._paths.extend((1, p) for p in route.paths)
            self._parked = True
        if self._went():
            self._go("end")

    def _ended(self) -> None:
        """Nothing more."""
