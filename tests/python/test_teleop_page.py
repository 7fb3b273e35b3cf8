"""The live page of a teleoperator in a real browser; nothing here depends on speed."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

from palpate.studies._browser import PHONE, browser, dismiss, find_browser, opened

pytest.importorskip("mujoco")
pytest.importorskip("cryptography")
pytest.importorskip("viser", reason="the page needs the extra view")
pytest.importorskip("playwright", reason="the browser is driven by playwright")
pytestmark = [
    pytest.mark.skipif(find_browser() is None, reason="no Chromium on this machine"),
    pytest.mark.timeout(1200),
]

from palpate.errors import DriverError  # noqa: E402
from palpate.teleop.channel import Faults  # noqa: E402
from palpate.teleop.rate_control import Curve, RateMaster, Reading  # noqa: E402
from palpate.teleop.session import Run  # noqa: E402
from palpate.teleop.setups import Setup, build  # noqa: E402
from palpate.view.teleop import Person, TeleopPage, take_over  # noqa: E402

LONG_S = 240.0


def until(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def test_a_person_takes_the_hand_over_without_a_jump() -> None:
    person = Person(lambda t: np.array([0.05, 0.0, 0.0]), 10.0)
    places = []
    for k in range(4000):
        if k == 1000:
            person.go(np.array([0.0, 0.1, 0.0]))
        if k == 1300:
            person.go(np.array([0.0, 0.0, 0.1]))
        if k == 2900:
            person.go(None)
        places.append(person(1e-3 * k))
    assert places[0] == pytest.approx([0.05, 0.0, 0.0])
    assert places[2890] == pytest.approx([0.05, 0.0, 0.1], abs=1e-6)
    assert np.abs(np.diff(places, axis=0)).max() < 3e-4


class Shown:
    """A run with its page, kept going by a thread."""

    def __init__(self, setup: Setup, faults: Faults | None = None) -> None:
        self.setup = setup
        self.page = TeleopPage(setup, person=take_over(setup), faults=faults, port=0)
        self.complaints: list[str] = []
        self._over = threading.Event()
        self._found: list[Run] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._found.append(self.setup.run(seconds=3600.0, tap=self.page.tap, stop=self._over.is_set))

    def open(self, chromium: Browser, size: tuple[int, int] = (1000, 700)) -> Page:
        things = len(self.setup.slave.model.solid_shapes())
        shown = opened(chromium, self.page.url, size, things, LONG_S)
        shown.on("pageerror", lambda error: self.complaints.append(str(error)))
        dismiss(shown)
        return shown

    def close(self) -> Run:
        """End both; what happened."""
        self._over.set()
        self._thread.join(LONG_S)
        self.page.close()
        return self._found[0]


def set_value(shown: Page, label: str, value: float) -> None:
    """Type beside a label."""
    # viser may break a long label into several elements, so its whole text is compared
    row = shown.locator("label", has_text=label).locator(
        "xpath=ancestor::*[.//input[not(@type='hidden')]][1]"
    )
    field = row.locator("input:not([type=hidden])").first
    field.fill(f"{value:g}")
    field.press("Enter")


def colours(shown: Page) -> int:
    """How many different ones are in the picture."""
    from PIL import Image

    picture = np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("RGB"))
    return len(np.unique(picture.reshape(-1, 3) // 16, axis=0))


def test_a_person_makes_the_network_worse_and_reads_why_it_holds(tmp_path: Path) -> None:
    run = Shown(build("wall"), Faults(delay=0.02, duplicate=0.3))
    page = run.page
    try:
        with browser() as chromium:
            shown = run.open(chromium)
            shown.get_by_text("delay 20 ms").wait_for()
            shown.get_by_text("coupled").first.wait_for()
            set_value(shown, "loss [%]", 10)
            until(lambda: page.faults.loss == pytest.approx(0.1))
            assert page.faults.duplicate == 0.3, "what has no slider stays"
            shown.get_by_role("button", name="Cut the link").click()
            shown.get_by_text("the link is dead").first.wait_for()
            frames = page.frames
            until(lambda: page.frames > frames + 10)
            shown.screenshot(path=tmp_path / "held.png")
            shown.get_by_role("button", name="Restore the link").click()
            until(lambda: not page.cut)
            shown.get_by_text("the link is dead").first.wait_for(state="hidden")
            shown.screenshot(path=tmp_path / "page.png")
            assert colours(shown) > 8, "an arm is in the picture"
        assert not run.complaints
    finally:
        out = run.close()
    assert any("the link is dead" in text for _, text in out.reasons)


def test_a_leader_and_its_twin_are_on_the_page_and_a_person_leads(tmp_path: Path) -> None:
    run = Shown(build(None, arm="so101"), Faults(delay=1.5))  # beyond the slider
    page, arm = run.page, run.setup.slave.model
    start = run.setup.slave.seen.q.copy()

    def led(least: float) -> bool:
        """Both arms have been turned at the first joint [rad]."""
        now, k = page._run or pytest.fail("it runs")
        return min(now.device[k, 0], now.q[k, 0]) - start[0] > least

    try:
        with browser() as chromium:
            shown = run.open(chromium)
            for name in (joint.name for joint in arm.joints):
                shown.get_by_role("cell", name=name).wait_for()
            shown.get_by_text("delay 1500 ms").wait_for()
            set_value(shown, "delay [ms]", 0)
            shown.get_by_text("coupled").first.wait_for()
            shown.get_by_text("torque true").wait_for()
            shown.get_by_text("moved by these, not by the script").click()
            set_value(shown, f"{arm.joints[0].name} [deg]", 20)
            until(lambda: led(0.2))
            shown.screenshot(path=tmp_path / "twins.png")
            assert colours(shown) > 8, "the arms are in the picture"
            shown.close()
            shown = run.open(chromium, PHONE)
            shown.get_by_text("torque true").wait_for()
            assert shown.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
            shown.screenshot(path=tmp_path / "phone.png")
        assert not run.complaints
    finally:
        run.close()


class Cap:
    """A device whose cable may come out."""

    name, usage, curve = "a <cap>", "push the cap", Curve()

    def __init__(self) -> None:
        self.out = False

    def read(self) -> Reading:
        if self.out:
            raise DriverError("a <cap> is unplugged; plug it in again")
        return Reading(np.zeros(6), "let go of it once")

    def feel(self, part: float) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_device_says_on_the_page_how_it_is_used_and_that_it_is_unplugged() -> None:
    cap = Cap()
    setup = build(None, device=RateMaster(cap))
    assert take_over(setup) is None
    run = Shown(setup)
    try:
        with browser() as chromium:
            shown = run.open(chromium)
            shown.get_by_text("push the cap").wait_for()
            shown.get_by_text("let go of it once").wait_for()
            assert shown.get_by_text("moved by these").count() == 0
            cap.out = True
            shown.get_by_text("device: a <cap> is unplugged; plug it in again").wait_for()
            shown.get_by_text("held", exact=True).wait_for()
            cap.out = False
            shown.get_by_text("is unplugged").wait_for(state="hidden")
        assert not run.complaints
    finally:
        run.close()
