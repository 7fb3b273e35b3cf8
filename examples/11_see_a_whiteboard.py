"""A whiteboard in a picture: where it is, what is written on it in metres, and what a wipe took away.

Needs palpate[vision]. Prints:

    board 0.900 x 0.600 m, dirty, confidence above 0.9
    stroke from (0.196, 0.150) to (0.505, 0.150) m
    erased 100 %, new 0
"""

from __future__ import annotations

import cv2
import numpy as np

from palpate import vision

SIZE = (0.90, 0.60)  # [m]
CORNERS = np.array([[310, 120], [1010, 190], [960, 610], [270, 560]], np.float32)  # [pixels]


def photograph(written: bool) -> np.ndarray:
    """A made-up picture: grey frame, white surface, one stroke of a pen."""
    face = np.full((660, 960, 3), 150, np.uint8)  # 1 mm a pixel, the frame 30 mm wide
    cv2.rectangle(face, (30, 30), (929, 629), (222, 226, 224), -1)
    if written:
        cv2.line(face, (230, 180), (530, 180), (160, 60, 20), 7)
    flat = np.array([[30, 30], [930, 30], [930, 630], [30, 630]], np.float32) - 0.5
    image = np.full((720, 1280, 3), 95, np.uint8)
    H = cv2.getPerspectiveTransform(flat, CORNERS)
    cv2.warpPerspective(face, H, (1280, 720), image, borderMode=cv2.BORDER_TRANSPARENT)
    return image


before, after = photograph(written=True), photograph(written=False)
sight = vision.see(before, size=SIZE)
assert sight.board is not None and sight.plane is not None and sight.board.confidence > 0.9
print("board {:.3f} x {:.3f} m, {}, confidence above 0.9".format(*SIZE, "dirty" if sight.dirty else "clean"))
stroke = sight.ink_polygons[0]
y = stroke[:, 1].mean()
print(f"stroke from ({stroke[:, 0].min():.3f}, {y:.3f}) to ({stroke[:, 0].max():.3f}, {y:.3f}) m")
later = vision.see(after)
assert later.board is not None
change = vision.compare(before, after, sight.board.corners, later.board.corners, size=SIZE)
print(f"erased {100 * change.erased:.0f} %, new {change.new.sum()}")
