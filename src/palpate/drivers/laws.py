"""The laws every driver obeys, as tests: subclass :class:`DriverLaws` in a pytest module and say how to make yours.

>>> class TestMyDriver(DriverLaws):
...     def make(self):
...         return MyDriver("/dev/ttyUSB0")
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..arm import Array
from ..errors import DriverError
from ..logs import Sample
from .driver import Driver


class DriverLaws:
    """What holds for every driver, simulated, replayed or real. The arm moves a little: small torques only."""

    torque = 0.01
    """largest torque that is sent, any joint [N m]"""
    periods = 20
    """how many periods a test reads, at most"""
    effort_tolerance = 1e-9
    """by how much the next sample's effort may differ from what write() returned [N m]; a real drive that measures its
    current needs more"""

    def make(self) -> Driver:
        """A driver that is closed."""
        raise NotImplementedError("a subclass of DriverLaws says which driver it is about: make()")

    def _refused(self, what: Callable[[], object], *words: str) -> None:
        try:
            what()
        except DriverError as error:
            message = str(error)
            assert "\n" not in message, f"an error is one line, got {message!r}"
            for word in words:
                assert word in message, f"expected {word!r} in {message!r}"
        else:
            raise AssertionError("expected a DriverError")

    def _is(self, driver: Driver, state: str) -> None:
        assert driver.state == state, f"expected {state}, is {driver.state}"

    def _read(self, driver: Driver) -> Sample:
        """The next sample that arrives."""
        for _ in range(self.periods):
            sample = driver.read()
            if sample is not None:
                return sample
        raise AssertionError(f"no sample in {self.periods} periods")

    def _command(self, driver: Driver, k: int) -> Array:
        return self.torque * np.sin(k + np.arange(driver.n))

    def test_says_what_it_is(self) -> None:
        """Joint names, period and the meaning of effort are known before the arm is reached."""
        driver = self.make()
        assert driver.n == len(driver.joint_names) >= 1
        assert len(set(driver.joint_names)) == driver.n
        assert isinstance(driver.period_ns, int) and driver.period_ns > 0
        assert driver.effort.kind in ("torque", "current", "phase_currents", "undeclared")
        assert driver.state == "closed" and not driver.finished

    def test_verbs_out_of_order_are_refused(self) -> None:
        """Every verb before its time is a DriverError that names what must come first."""
        driver = self.make()
        zero = np.zeros(driver.n)
        self._refused(driver.read, "connect()")
        self._refused(driver.enable, "connect()")
        self._refused(driver.disable, "connect()")
        self._refused(lambda: driver.write(zero), "enable()")
        driver.connect()
        try:
            self._refused(driver.connect, "already")
            self._refused(lambda: driver.write(zero), "enable()", "connected")
            driver.enable()
            driver.enable()
            driver.disable()
            driver.disable()
            self._refused(lambda: driver.write(zero), "enable()")
        finally:
            driver.close()
        self._refused(driver.read, "connect()")
        self._refused(lambda: driver.write(zero), "closed")

    def test_stop_and_close_work_in_every_state(self) -> None:
        """stop() and close() may come at any time and any number of times."""
        driver = self.make()
        driver.stop()
        driver.close()
        for _ in range(2):
            driver.connect()
            driver.stop()
            driver.enable()
            self._is(driver, "enabled")
            driver.stop()
            driver.stop()
            self._is(driver, "connected")
            self._read(driver)
            driver.enable()
            driver.close()
            driver.close()
            driver.stop()
            self._is(driver, "closed")

    def test_leaving_the_block_closes(self) -> None:
        """An error inside a with block leaves the driver closed."""
        driver = self.make()
        try:
            with driver as same:
                assert same is driver and driver.state == "connected"
                driver.enable()
                raise KeyError("something went wrong in the loop")
        except KeyError:
            pass
        assert driver.state == "closed"

    def test_samples_have_the_right_shape_and_rising_times(self) -> None:
        """Samples are float64 of shape (n,), their times rise."""
        with self.make() as driver:
            last = None
            for _ in range(self.periods):
                sample = None if driver.finished else driver.read()
                if sample is None:
                    continue
                assert isinstance(sample.time_ns, int)
                assert last is None or sample.time_ns > last
                last = sample.time_ns
                for array in (sample.position, sample.velocity, sample.effort, sample.model_torque):
                    if array is not None:
                        assert array.shape == (driver.n,) and array.dtype == np.float64
                assert np.isfinite(sample.position).all()
            assert last is not None

    def test_samples_stay_as_they_were(self) -> None:
        """Later periods do not change a sample that was handed out."""
        with self.make() as driver:
            driver.enable()
            first = self._read(driver)
            position, effort = first.position.copy(), first.effort.copy()
            for k in range(self.periods):
                driver.write(self._command(driver, k))
                if not driver.finished:
                    driver.read()
            assert np.array_equal(first.position, position)
            assert np.array_equal(first.effort, effort, equal_nan=True)

    def test_write_says_what_was_sent(self) -> None:
        """write() returns what the drives apply: once held for a whole period, the sample's effort is just that."""
        with self.make() as driver:
            driver.enable()
            gain = driver.effort.gain(driver.n)
            sent, held = np.zeros(driver.n), False
            for k in range(self.periods):
                sample = None if driver.finished else driver.read()
                if sample is not None and held:
                    np.testing.assert_allclose(
                        sample.effort * gain, sent, rtol=0.0, atol=self.effort_tolerance
                    )
                command = self._command(driver, k // 2)
                given = command.copy()
                sent, held = driver.write(command), k % 2 == 1 and sample is not None
                assert sent.shape == (driver.n,) and sent.dtype == np.float64
                assert np.isfinite(sent).all()
                assert np.array_equal(command, given), "write() must not change its argument"
                kept = sent.copy()
                sent += 1.0  # the caller's own: this must not reach the drives
                sent = kept

    def test_write_takes_lists_and_integers(self) -> None:
        """Lists, tuples and integer arrays are torques too."""
        with self.make() as driver:
            driver.enable()
            self._read(driver)
            expected = driver.write(np.zeros(driver.n))
            for zero in ([0] * driver.n, tuple([0.0] * driver.n), np.zeros(driver.n, dtype=np.int32)):
                assert np.array_equal(driver.write(zero), expected)

    def test_refused_commands_stop_the_drives(self) -> None:
        """NaN, infinities and wrong shapes are refused, and the drives are off afterwards."""
        with self.make() as driver:
            zero = np.zeros(driver.n)
            bad: list[Any] = [np.full(driver.n, v) for v in (np.nan, np.inf, -np.inf)]
            bad += [np.zeros(driver.n + 1), np.zeros((1, driver.n)), 0.0, "torque", None]
            for command in bad:
                driver.enable()
                driver.write(zero)
                self._refused(partial(driver.write, command), "torque", "stopped")
                self._is(driver, "connected")
                self._refused(lambda: driver.write(zero), "enable()", "stopped")

    def test_a_finished_driver_says_so(self) -> None:
        """Reading works until the driver is finished, and not after."""
        driver = self.make()
        with driver:
            for _ in range(self.periods):
                if driver.finished:
                    self._refused(driver.read, "ended")
                    return
                driver.read()

    def test_connecting_again_starts_again(self) -> None:
        """A closed driver connects again."""
        driver = self.make()
        shapes = []
        for _ in range(2):
            driver.connect()
            sample = self._read(driver)
            shapes.append((sample.position.shape, sample.velocity is None))
            driver.close()
        assert shapes[0] == shapes[1]
