"""The live page of a teleoperator in a real browser; nothing here depends on speed."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.studies._browser import browser, dismiss, find_browser, opened

pytest.importorskip("mujoco")
pytest.importorskip("cryptography")
pytest.importorskip("viser", reason="the page needs the extra view")
pytest.importorskip("playwright", reason="the browser is driven by playwright")
pytestmark = [
    pytest.mark.skipif(find_browser() is None, reason="no Chromium on this machine"),
    pytest.mark.timeout(1200),
]

from palpate.teleop.channel import Faults  # noqa: E402
from palpate.teleop.session import Run  # noqa: E402
from palpate.teleop.setups import build  # noqa: E402
from palpate.view.teleop import Person, TeleopPage  # noqa: E402

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
    assert places[2890] == pytest.approx([0.0, 0.0, 0.1], abs=1e-6)
    assert np.abs(np.diff(places, axis=0)).max() < 3e-4


def test_a_person_makes_the_network_worse_and_reads_why_it_holds(tmp_path: Path) -> None:
    setup = build("wall")
    page = TeleopPage(setup, faults=Faults(delay=0.02), port=0)
    over = threading.Event()
    found: list[Run] = []
    thread = threading.Thread(
        target=lambda: found.append(setup.run(seconds=3600.0, tap=page.tap, stop=over.is_set)), daemon=True
    )
    thread.start()
    complaints: list[str] = []
    try:
        with browser() as chromium:
            shown = opened(chromium, page.url, (1000, 700), len(setup.slave.model.solid_shapes()), LONG_S)
            shown.on("pageerror", lambda error: complaints.append(str(error)))
            dismiss(shown)
            shown.get_by_text("delay 20 ms").wait_for()
            shown.get_by_text("coupled").first.wait_for()
            row = shown.locator("label:text-is('loss [%]')").locator(
                "xpath=ancestor::*[.//input[not(@type='hidden')]][1]"
            )
            field = row.locator("input:not([type=hidden])").first
            field.fill("10")
            field.press("Enter")
            until(lambda: page.faults.loss == pytest.approx(0.1))
            shown.get_by_role("button", name="Cut the link").click()
            shown.get_by_text("the link is dead").first.wait_for()
            frames = page.frames
            until(lambda: page.frames > frames + 10)
            shown.screenshot(path=tmp_path / "held.png")
            shown.get_by_role("button", name="Restore the link").click()
            until(lambda: not page.cut)
            shown.get_by_text("the link is dead").first.wait_for(state="hidden")
            shown.screenshot(path=tmp_path / "page.png")

            from PIL import Image

            picture = np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("RGB"))
            assert len(np.unique(picture.reshape(-1, 3) // 16, axis=0)) > 8, "an arm is in the picture"
        assert not complaints
    finally:
        over.set()
        thread.join(LONG_S)
        page.close()
    assert any("the link is dead" in text for _, text in found[0].reasons)
