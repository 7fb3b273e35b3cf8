"""A node: topics to publish and to read, parameters, diagnostics, and the loop that serves them all."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Self

from ..errors import InputError
from .arguments import RosArguments
from .context import Context
from .messages import (
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    Log,
    Malformed,
    Parameter,
    ParameterEvent,
    Time,
)
from .names import expand, remapped, renamed
from .parameters import Parameters
from .transport import DEFAULT, STREAM, Endpoint, Reliability, Seat, Server, full_name

_HOUSEKEEPING = 0.2
"""time between two looks at what changes seldom [s]"""
_ALONE = 5.0
"""how long nobody may publish what a node reads until it says so [s]"""
_DIAGNOSTICS = 1.0
"""[s]"""
_COMPLAINT = 10.0
"""how long messages that are none are spoken of after the last of them [s]"""
_LEVELS = ("ok", "warning", "error")


class Publisher:
    """Publishes messages of one type on one topic."""

    def __init__(self, seat: Seat, message: type[Any], name: str, how: Reliability) -> None:
        self.name = name
        """full name"""
        self.unsent = 0
        """messages given up because a reader took none for 0.1 s; over Zenoh nobody tells"""
        self._writer = seat.writer(message, name, how)

    def publish(self, message: Any) -> None:
        """Send a message; a reader that takes none any more makes it be dropped and counted.

        Raises:
            InputError: a field holds what its type cannot.
        """
        try:
            self.unsent += not self._writer.write(message)
        except Exception as error:  # noqa: BLE001 cyclonedds raises bare ones
            raise InputError(f"{self.name}: {' '.join(str(error).split())[:200]}") from None

    def flush(self, timeout: float) -> bool:
        """Wait until every reliable reader has what was sent, at most `timeout` [s]; whether they are known to."""
        return self._writer.flush(timeout)

    def close(self) -> None:
        """Publish no more; readers are told at once, whoever still holds this."""
        self._writer.close()

    @property
    def readers(self) -> int:
        """How many read it now."""
        return self._writer.readers


class Subscription:
    """Reads one topic: reliably where that is offered, else as it comes."""

    def __init__(
        self,
        context: Context,
        seat: Seat,
        message: type[Any],
        name: str,
        how: Reliability,
        callback: Callable[[Any, int], None],
        optional: bool = False,
    ) -> None:
        self.name = name
        """full name"""
        self.message = message
        self.malformed = 0
        """messages whose bytes were not of this type"""
        self._context, self._seat, self._how = context, seat, how
        self._callback, self._optional = callback, optional
        self.latched = how.latched
        self._malformed, self._complain_until, self._reason = 0, 0.0, ""
        self._reader = seat.reader(message, name, how)
        self._since = time.monotonic()

    def take(self) -> int:
        """Give what has come to the callback, with a number for its writer; how many messages that were."""
        count = 0
        for message, writer in self._reader.take():
            if isinstance(message, Malformed):
                self.malformed += 1
                self._reason = self._reason or message.reason
            else:
                count += 1
                self._callback(message, writer)
        return count

    def close(self) -> None:
        """Read no more."""
        self._reader.close()

    @property
    def writers(self) -> int:
        """How many writers of this type are known now."""
        return self._reader.writers

    def alive(self, writer: int) -> bool:
        """Whether the writer of this number may still be there."""
        return self._reader.alive(writer)

    @property
    def missed(self) -> int:
        """Messages that are known to be lost on the way, or because they came faster than they were taken.

        DDS tells of none.
        """
        return self._reader.missed

    def publishers(self) -> list[Endpoint]:
        """Who publishes on this topic, of any type."""
        return self._context.publishers(self.name)

    def look(self) -> str:
        """Take what is offered; what keeps messages away, in one line, or nothing."""
        now = time.monotonic()
        if self.malformed > self._malformed:
            self._malformed = self.malformed
            self._complain_until = now + _COMPLAINT
        if self.writers:
            self._since = now
            if now >= self._complain_until:
                self._reason = ""
            return self._reason and f"{self.name}: some messages are not {self._type}: {self._reason}"
        known = self.publishers()
        others = sorted({p.type for p in known if p.type != self._type})
        if self._how.reliable and any(p.type == self._type and not p.reliable for p in known):
            # a reader that insists on getting everything gets nothing from a writer that promises nothing
            self._how = Reliability(False, self._how.latched, self._how.depth)
            self._reader.close()
            self._reader = self._seat.reader(self.message, self.name, self._how)
            self._since = now
            return ""
        if others:
            return f"{self.name} is published as {', '.join(others)}; expected {self._type}"
        if now - self._since < _ALONE or (self._optional and not known):
            return ""
        if known:
            nodes = ", ".join(sorted({p.node or "an unnamed node" for p in known}))
            return f"{self.name} of {nodes} does not fit: another definition of {self._type}, or another QoS"
        topics = sorted({p.topic for p in self._context.publishers() if p.type == self._type})
        where = f"nobody publishes {self.name} in domain {self._context.domain}"
        if topics:
            return f"{where}; {self._type} is on {', '.join(topics[:10])}"
        return (
            f"{where}, nor any {self._type}: is it another domain (ROS_DOMAIN_ID), or has it not started?"
            + self._context.transport.alone()
        )

    @property
    def _type(self) -> str:
        name: str = self.message.ros_type
        return name


class Node:
    """A node of the graph; :meth:`spin` lets it work.

    Topics: ``/diagnostics`` (every second and at every change), ``/rosout``, ``/parameter_events``; services: the six
    of the parameters.

    Args:
        name: its name unless it is remapped.
        context: where it lives; it stays the caller's to close.
        space: its namespace unless that is remapped.
        arguments: remappings and values of parameters.
        quiet: say nothing on stderr.

    Raises:
        InputError: a name is none.
    """

    def __init__(
        self,
        name: str,
        context: Context,
        *,
        space: str = "/",
        arguments: RosArguments | None = None,
        quiet: bool = False,
    ) -> None:
        arguments = arguments or RosArguments()
        self.context = context
        self._remaps = arguments.remaps
        self.space, self.name = renamed(space, name, self._remaps)
        self._was = name
        self._quiet = quiet
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._services: list[Server] = []
        self._seat = context.transport.join(self.space, self.name)
        self._closed = False
        self._troubles: dict[str, tuple[int, str]] = {}
        self._facts: dict[str, str] = {}
        self._watch: list[Callable[[], None]] = []
        self._next = self._next_diagnostics = 0.0
        self.parameters = Parameters(self.full_name, arguments.overrides)
        self.parameters.declare(
            "use_sim_time", False, "without effect: only the stamps of messages count here"
        )
        self._diagnostics = self.publish(DiagnosticArray, "/diagnostics", DEFAULT)
        self._rosout = self.publish(Log, "/rosout", Reliability(latched=True, depth=100))
        self._events = self.publish(ParameterEvent, "/parameter_events", DEFAULT)
        self.parameters.changed = self._tell_change
        for service, (request, reply, handle) in self.parameters.services().items():
            full = expand(f"~/{service}", self.space, self.name)
            self._services.append(self._seat.server(full, request, reply, handle))

    @property
    def full_name(self) -> str:
        """With its namespace."""
        return full_name(self.space, self.name)

    def resolve(self, topic: str) -> str:
        """The full name of a topic after remapping."""
        # a rule for one node names it as it was before it was renamed
        return remapped(topic, self.space, self.name, [r for r in self._remaps if r.node in ("", self._was)])

    def publish(self, message: type[Any], topic: str, how: Reliability = STREAM) -> Publisher:
        """A publisher.

        Raises:
            InputError: the topic's name is none.
        """
        made = Publisher(self._seat, message, self.resolve(topic), how)
        self._publishers.append(made)
        return made

    def subscribe(
        self,
        message: type[Any],
        topic: str,
        callback: Callable[[Any, int], None],
        how: Reliability = STREAM,
        *,
        optional: bool = False,
    ) -> Subscription:
        """Have `callback` called with every message and a number for its writer, within :meth:`spin_once`.

        optional: nothing is wrong where nobody publishes it.

        Raises:
            InputError: the topic's name is none.
        """
        name = self.resolve(topic)
        made = Subscription(self.context, self._seat, message, name, how, callback, optional)
        self._subscriptions.append(made)
        return made

    def watch(self, look: Callable[[], None]) -> None:
        """Have `look` called some times a second within :meth:`spin_once`."""
        self._watch.append(look)

    # --- saying what is wrong ------------------------------------------------------------------------------------

    def trouble(self, key: str, text: str, *, error: bool = True) -> None:
        """What is wrong with `key` from now on; an empty text: nothing any more. Said once, when it changes."""
        level = 0 if not text else 2 if error else 1
        before = self._troubles.get(key, (0, ""))
        if before == (level, text):
            return
        self._troubles[key] = (level, text)
        self._next_diagnostics = 0.0
        if level:
            self.log(text, level=40 if error else 30)
        elif before[0]:
            self.log(f"{key}: all right again")

    def fact(self, key: str, value: object) -> None:
        """A value for the diagnostics."""
        self._facts[key] = str(value)

    @property
    def troubles(self) -> list[str]:
        """What is wrong now."""
        return [text for level, text in self._troubles.values() if level]

    def log(self, text: str, *, level: int = 20) -> None:
        """Say something on stderr and to ``/rosout``; levels are those of ``rcl_interfaces/msg/Log``."""
        if not self._quiet:
            word = {20: "", 30: "warning: ", 40: "error: "}.get(level, "")
            sys.stderr.write(f"[{self.full_name}] {word}{text}\n")
            sys.stderr.flush()
        self._rosout.publish(Log(Time.of(time.time_ns()), level, self.name, text))

    def _tell_change(self, parameters: list[Parameter]) -> None:
        self._events.publish(
            ParameterEvent(Time.of(time.time_ns()), self.full_name, changed_parameters=parameters)
        )

    def _tell_diagnostics(self) -> None:
        states = []
        for key, (level, text) in self._troubles.items():
            states.append(DiagnosticStatus(level, f"{self.name}: {key}", text or "ok", self.full_name))
        worst = max((level for level, _ in self._troubles.values()), default=0)
        values = [KeyValue(key, value) for key, value in self._facts.items()]
        states.insert(
            0, DiagnosticStatus(worst, self.name, "; ".join(self.troubles) or "ok", self.full_name, values)
        )
        self._diagnostics.publish(DiagnosticArray(Header(Time.of(time.time_ns())), states))

    # --- working -------------------------------------------------------------------------------------------------

    def spin_once(self, timeout: float = 0.1) -> int:
        """Wait at most `timeout` [s] for something to come and deal with it; how many messages that were.

        Raises:
            PalpateError: a callback raised it.
        """
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _HOUSEKEEPING
            self._keep_house(now)
        if timeout > 0.0:
            self._seat.wait(timeout)
        count = sum(subscription.take() for subscription in self._subscriptions)
        for service in self._services:
            service.serve()
        return count

    def _keep_house(self, now: float) -> None:
        for subscription in self._subscriptions:
            self.trouble(subscription.name, subscription.look())
        for look in self._watch:
            look()
        unsent = sum(publisher.unsent for publisher in self._publishers)
        if unsent:
            self.fact("unsent", unsent)
        # what is latched is lost by being replaced: only the newest was asked for
        missed = sum(subscription.missed for subscription in self._subscriptions if not subscription.latched)
        if missed:
            self.fact("missed", missed)
        if now >= self._next_diagnostics:
            self._next_diagnostics = now + _DIAGNOSTICS
            self._tell_diagnostics()

    def spin_until(self, done: Callable[[], bool], timeout: float | None = None) -> bool:
        """Work until `done()`, at most `timeout` [s]; whether it was."""
        end = None if timeout is None else time.monotonic() + timeout
        while not done():
            if end is not None and time.monotonic() >= end:
                return False
            self.spin_once(0.05)
        return True

    def close(self) -> None:
        """Leave the graph. Closed already: nothing happens."""
        if self._closed:
            return
        self._closed = True
        endpoints: list[Any] = [*self._subscriptions, *self._publishers, *self._services]
        for endpoint in endpoints:
            endpoint.close()
        self._subscriptions.clear()
        self._publishers.clear()
        self._services.clear()
        self._seat.leave()
        self.parameters.changed = lambda _: None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def together(nodes: Sequence[Node], done: Callable[[], bool], timeout: float) -> bool:
    """Let nodes of one process work in turn until `done()`, at most `timeout` [s]; whether it was."""
    end = time.monotonic() + timeout
    while not done():
        if time.monotonic() >= end:
            return False
        if not sum(node.spin_once(0.0) for node in nodes):
            nodes[0].spin_once(0.002)
    return True
