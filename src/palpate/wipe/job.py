"""The whole job: see, hold, wipe, check."""

from __future__ import annotations

import math
import time
from typing import Literal, TypeAlias

import numpy as np

from ..arm import Array
from ..errors import InputError
from .activity import Activity, Slot, timing
from .fast import Control, Estimation, Robot, Torques, Wipe
from .mediator import Mediator, Memory, Others
from .options import JobOptions
from .result import Event, JobResult, Kind, Look, Observer, Pass, Tick, Timing, Track
from .scene import BoardScene, _table
from .slow import Navigation, Perception
from .strokes import Plan

Clock: TypeAlias = Literal["simulated", "wall"]

PERIODS_NS = {
    "perception": 100_000_000,
    "estimation": 8_000_000,
    "control": 8_000_000,
    "navigation": 100_000_000,
    "robot": 4_000_000,
    "mediator": 100_000_000,
}
STALE = 3
"""cycles of control without a command after which the robot holds by itself"""
BASE_NS = PERIODS_NS["robot"]


class WipeJob:
    """Wipe the board of a scene.

    >>> job = WipeJob(scene, JobOptions(speed=0.1))  # doctest: +SKIP
    >>> result = job.run(observer=MyObserver())  # doctest: +SKIP
    >>> result.verdict, result.ink_left  # doctest: +SKIP

    Args:
        scene: with both arms where they are; the job takes the eraser's arm out of the camera's view first.
        options: None: as the defaults say.
    """

    def __init__(self, scene: BoardScene, options: JobOptions | None = None) -> None:
        self.scene = scene
        self.options = options or JobOptions()
        self._passes: list[Pass] = []
        self._open: tuple[Plan, int, float, float] | None = None
        self._events: list[Event] = []
        self._rows: list[tuple[float, ...]] = []
        self._phases: list[str] = []
        self._looks: list[Look] = []
        self._memory = Memory()
        self._told = 0
        self._cycles: dict[str, list[float]] = {name: [] for name in (*PERIODS_NS, "simulation")}
        self._ink = scene.ink.area
        self._wish: Slot[str] = Slot()
        self._done = False
        self._mediator: Mediator | None = None
        self._observer: Observer | None = None
        self._at_start: Array | None = None

    # -- from any thread -------------------------------------------------------

    def pause(self) -> None:
        """Both hands come to rest; the eraser's stays compliant, and its elbow may still settle; from any thread."""
        self._wish.put("pause")

    def resume(self) -> None:
        """Go on after a pause."""
        self._wish.put("resume")

    def stop(self) -> None:
        """End safely: come to rest, lift the eraser, park; from any thread."""
        self._wish.put("stop")

    @property
    def progress(self) -> tuple[float, float]:
        """Part done of the pass's strokes (0 to 1), and simulated seconds left of it by the plan."""
        wipe = self._mediator.wipe if self._mediator is not None else None
        if wipe is None or not wipe.total > 0.0:
            return 0.0, math.nan
        return 1.0 - wipe.remaining / wipe.total, wipe.remaining

    # -- running ---------------------------------------------------------------

    def run(
        self, *, observer: Observer | None = None, clock: Clock = "simulated", limit: float = 600.0
    ) -> JobResult:
        """Until the board is clean, the passes are used up, or it was stopped or had to stop.

        After a stop with ``resumable`` another call goes on: it looks again, and wipes what is still dirty.

        Args:
            observer: told everything while it runs.
            clock: simulated: as fast as it goes, the same seed the same run; wall: no faster than real time, and what
                takes long is done in threads.
            limit: simulated time of this call at most [s].

        Raises:
            InputError: no such clock, or the job has ended for good.
        """
        if clock not in ("simulated", "wall"):
            raise InputError(f"clock must be simulated or wall, got {clock!r}")
        if self._done:
            raise InputError("this job has ended; make a new one")
        scene, begin = self.scene, time.perf_counter()
        self._observer = observer
        others, mediator = self._assemble(clock == "wall")
        activities: tuple[Activity, ...] = (
            others.perception,
            others.navigation,
            mediator,
            others.estimation,
            others.control,
            others.robot,
        )
        for activity in reversed(activities):
            activity.begin()
        start = scene.time_ns
        paused = False
        try:
            while mediator.task != "ended":
                now = scene.time_ns
                wish = self._wish.take()
                if wish == "stop" or (now - start) * 1e-9 >= limit:
                    if wish != "stop":
                        mediator.stop(f"it was not done within {limit:g} s")
                    else:
                        mediator.stop("a person stopped it")
                    paused = self._pause(activities, False, paused)
                    limit = math.inf
                elif wish is not None:
                    paused = self._pause(activities, wish == "pause", paused)
                for activity in activities:
                    if (now - start) % activity.period_ns == 0:
                        activity.cycle(now)
                world = time.perf_counter()
                scene.step(*others.robot.sent, BASE_NS)
                others.robot.read()
                self._cycles["simulation"].append(time.perf_counter() - world)
                self._record(others, mediator, activities)
                if clock == "wall":
                    ahead = (scene.time_ns - start) * 1e-9 - (time.perf_counter() - begin)
                    if ahead > 0.0:
                        time.sleep(ahead)
        finally:
            for activity in activities:
                activity.finish()
                self._cycles[activity.name] += activity.cycles
        self._done = not mediator.resumable
        return self._result(mediator, time.perf_counter() - begin, activities)

    def _assemble(self, threaded: bool) -> tuple[Others, Mediator]:
        scene, o, p = self.scene, self.options, PERIODS_NS
        command: Slot[Torques] = Slot()
        robot = Robot(scene, p["robot"], command, STALE * p["control"], o.seed + len(self._events))
        estimation = Estimation(scene.arms, p["estimation"], robot)
        home = tuple(np.zeros(a.n) for a in scene.arms)
        perception = Perception(scene, p["perception"], threaded)
        navigation = Navigation(scene, p["navigation"], threaded, o, (home[0], home[1]))
        control = Control(
            scene.arms, p["control"], estimation.felt, command, lambda text: mediator.faulted(text)
        )
        T = np.eye(4)
        T[:3, :3], centre = _table(scene.setting)
        T[:3, 3] = centre - T[:3, :3] @ [0.5 * scene.ink.size[0], 0.5 * scene.ink.size[1], 0.0]
        others = Others(
            scene.arms,
            robot,
            estimation,
            control,
            perception,
            navigation,
            T,
            scene.camera,
            scene.ink.size,
        )
        self._memory.broken = self._open is not None
        mediator = Mediator(p["mediator"], o, others, self._tell, self._pass, self._memory)
        self._mediator, self._told = mediator, 0
        for activity in (perception, navigation, mediator, estimation, control, robot):
            activity.told = lambda name, state: self._tell("activity", f"{name} is {state}")
        return others, mediator

    @staticmethod
    def _pause(activities: tuple[Activity, ...], pause: bool, paused: bool) -> bool:
        """Estimation and robot go on in a pause: the arms are held."""
        if pause != paused:
            for activity in activities:
                if activity.name not in ("estimation", "robot"):
                    activity.send("pause" if pause else "start")
        return pause

    # -- telling ---------------------------------------------------------------

    def _tell(self, kind: Kind, text: str) -> None:
        event = Event(self.scene.time_ns, kind, text)
        self._events.append(event)
        if self._observer is not None:
            self._observer.event(event)

    def _pass(self, what: str, plan: Plan | None, seen: float) -> None:
        """A pass begins, is halted, goes on or is done."""
        if what == "begun":
            assert plan is not None
            self._open = plan, self.scene.time_ns, self.scene.ink.area, seen
            self._at_start = self.scene.T_world_board[:3, 3]
        elif what in ("done", "halted") and self._open is not None:
            plan, begin, area, seen = self._open
            self._passes.append(Pass(plan, begin, self.scene.time_ns, area, seen))
            self._at_start = None
            if what == "done":
                self._open = None
        elif what == "resumed" and self._open is not None:
            self._passes.pop()
            self._at_start = self.scene.T_world_board[:3, 3]

    def _record(self, others: Others, mediator: Mediator, activities: tuple[Activity, ...]) -> None:
        scene, report = self.scene, others.control.report.newest
        for look in mediator.looks[self._told :]:
            self._told += 1
            self._looks.append(look)
            if self._observer is not None:
                self._observer.look(look)
        if report is None:
            return
        effect, felt = report.effects[0], others.estimation.felt.newest
        assert felt is not None
        T = scene.T_world_board
        force = scene.contact_force
        normal = -float(force @ T[:3, 2])
        estimated = math.nan
        if mediator.T_base_board is not None:
            estimated = -float(felt.wrench[:3] @ mediator.T_base_board[:3, 2])
        commanded = np.zeros(6) if effect.commanded is None else effect.commanded
        wipe = others.control.laws[0]
        at = wipe.at if isinstance(wipe, Wipe) else np.full(3, math.nan)
        moved = math.nan
        if self._at_start is not None:
            moved = float(np.linalg.norm(T[:3, 3] - self._at_start))
        self._phases.append(effect.phase)
        self._rows.append(
            (
                scene.time_ns * 1e-9,
                effect.wanted_force,
                estimated,
                normal,
                math.sqrt(force @ force),
                math.sqrt(commanded[:3] @ commanded[:3]),
                math.sqrt(commanded[3:] @ commanded[3:]),
                *at,
                moved,
                effect.yielding,
                others.robot.held,
            )
        )
        observer = self._observer
        if observer is None or type(observer).tick is Observer.tick:
            return
        reading = others.robot.reading
        assert reading is not None
        arm = scene.arms[0]
        tool = arm.forward_kinematics(reading.q[0])
        tool[:3, 3] += tool[:3, :3] @ arm.grasp
        observer.tick(
            Tick(
                scene.time_ns,
                reading.q[0],
                felt.dq[0],
                reading.tau[0],
                reading.q[1],
                felt.dq[1],
                reading.tau[1],
                commanded,
                felt.wrench,
                felt.std,
                effect.wanted_force,
                estimated,
                force,
                normal,
                tool,
                T,
                mediator.T_base_board,
                mediator.task,
                mediator.number,
                effect.stroke,
                effect.phase,
                effect.yielding,
                others.robot.held,
                {a.name: a.state for a in activities},
            )
        )

    def _result(self, mediator: Mediator, wall: float, activities: tuple[Activity, ...]) -> JobResult:
        rows = np.array(self._rows).reshape(-1, 13)
        c = rows.T
        track = Track(
            time=c[0],
            phase=np.array(self._phases, dtype=np.str_),
            wanted=c[1],
            estimated=c[2],
            normal=c[3],
            contact=c[4],
            force=c[5],
            moment=c[6],
            tool=rows[:, 7:10],
            moved=c[10],
            yielding=c[11] > 0.5,
            held=c[12] > 0.5,
        )
        times: dict[str, Timing] = {
            a.name: timing(a.period_ns * 1e-9, self._cycles[a.name]) for a in activities
        }
        times["simulation"] = timing(BASE_NS * 1e-9, self._cycles["simulation"])
        done = [x for x in self._looks if x.why != "check"]
        return JobResult(
            mediator.verdict,
            mediator.reason,
            mediator.resumable,
            tuple(self._passes),
            self._ink,
            self.scene.ink.area,
            done[0] if done else None,
            done[-1] if done else None,
            self.scene.ink.work.copy(),
            tuple(self._events),
            track,
            times,
            len(rows) * BASE_NS * 1e-9,
            wall,
        )
