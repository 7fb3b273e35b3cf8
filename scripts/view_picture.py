#!/usr/bin/env python3
"""Draws docs/images/view.png: the live page of `palpate view`, a simulated arm that is pushed while it holds 250 g.

python scripts/view_picture.py [FILE]        needs the extras view and sim, playwright and a Chromium
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from palpate import weigh
from palpate.studies._browser import DESKTOP, browser, dismiss, opened
from palpate.view import Page, SimulatedArm


def main(target: Path) -> None:
    scene = weigh.scene(weigh.load_arm("justina_left_arm"))
    task = weigh.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],))
    source = SimulatedArm(weigh.simulated_driver(task), scene, mass=scene.mass)
    source.send("Take3")
    page = Page(source, port=0, title=scene.arm.name)
    source.start()
    over = threading.Event()
    updates = threading.Thread(target=page.run, args=(over.is_set,))
    updates.start()
    try:
        with browser() as found:
            seen = opened(found, page.url, DESKTOP, len(scene.arm.solid_shapes()))
            dismiss(seen)
            seen.wait_for_timeout(6000.0)
            source.go(0, "goal")
            seen.wait_for_timeout(5000.0)
            source.push(0, scene.arm.joints[-1].link, (0.0, 5.0, 0.0))
            seen.get_by_text("direction ±").first.wait_for()
            seen.wait_for_timeout(700.0)
            seen.screenshot(path=target)
    finally:
        over.set()
        updates.join()
        source.stop()
        page.close()
    print(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/images/view.png"))
