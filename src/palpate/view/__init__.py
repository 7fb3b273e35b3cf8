"""A live page in the browser: arms in 3-D, what they hold and what pushes them, and the controls for them.

Three parts, so that other programs can put their own arms and cameras on a page:

- :class:`Source` says what there is: one or more arms (:class:`ShownArm`: name, model, place in the world, poses), the
  newest :class:`Reading` of each, curves, pictures of cameras (:meth:`Source.images`), a state in words. What a person
  may do is told by the methods a source has: :class:`Moves`, :class:`Powers`, :class:`Holds`, :class:`Pushable`,
  :class:`Records`, :class:`Tunes`, :class:`Plays`; the page shows the controls for those and no others.
- :mod:`palpate.view.scene` decides what is shown, in plain values: the mass with its interval and what it is worth in
  words, arrow and cone of a force, lit links, the range of a curve. It knows no browser.
- :class:`Page` serves it by viser, 30 times a second out of the newest state, whatever the rate of the arm.

A page of two arms and a camera is a source whose ``arms`` has two entries, placed by ``T_world_base``, and whose
``images()`` returns ``{"camera": pixels}``, a new array for every new picture::

    class Pair(Source):
        arms = (
            ShownArm("master", master, T_world_base=T_left),
            ShownArm("slave", slave, T_world_base=T_right),
        )
        def reading(self, arm): return self._loop.newest[arm]      # never wait here
        def curves(self, arm, span): return self._histories[arm].curves(span)
        def images(self): return {"camera": self._loop.picture}
        ...

    page = Page(source)
    source.start()
    page.run(stop=lambda: done)

:class:`SimulatedArm`, :class:`RealArm` and :class:`WatchedArm` are sources with a loop of their own at the driver's
rate; :class:`Recording` is a log. Needs the extra ``view``.
"""

from __future__ import annotations

from .history import History
from .live import LiveArm, Motion, MovedArm, RealArm, SimulatedArm, WatchedArm, view_pipeline
from .page import FPS, Page, check_address
from .playback import Recording
from .scene import Badge, Channels, Force, ForceView, Reading, Scale, ShownArm, Weight
from .source import Holds, Image, Moves, Plays, Powers, Pushable, Records, Source, Tunes

__all__ = [
    "FPS",
    "Badge",
    "Channels",
    "Force",
    "ForceView",
    "History",
    "Holds",
    "Image",
    "LiveArm",
    "Motion",
    "MovedArm",
    "Moves",
    "Page",
    "Plays",
    "Powers",
    "Pushable",
    "Reading",
    "RealArm",
    "Recording",
    "Records",
    "Scale",
    "ShownArm",
    "SimulatedArm",
    "Source",
    "Tunes",
    "WatchedArm",
    "Weight",
    "check_address",
    "view_pipeline",
]
