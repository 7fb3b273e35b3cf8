"""Where an eraser has to go: a red line is wiped off a board, a black one stays. Needs palpate[wipe].

Prints:
    1 red line to wipe, 1 piece to keep
    1 stroke in 8 s, from (0.07, 0.14) to (0.43, 0.14)
    places that no stroke wipes: 0
    the arm gets there: True
    left: 0 % of the red ink, 100 % of the black ink
"""

import itertools

import numpy as np

from palpate import robots, wipe

layer = wipe.InkLayer((0.5, 0.35))
layer.stroke([(0.10, 0.10), (0.40, 0.10)], colour="red", width=0.006)
layer.stroke([(0.20, 0.25), (0.35, 0.25)], colour="black", width=0.006)

# what vision.see and wipe.ink_colours tell of a picture
red = np.array([(0.10, 0.097), (0.40, 0.097), (0.40, 0.103), (0.10, 0.103)])
black = np.array([(0.20, 0.247), (0.35, 0.247), (0.35, 0.253), (0.20, 0.253)])
chosen = wipe.choose([red, black], colours=["red", "black"], colour="red")
print(f"{len(chosen.wipe)} red line to wipe, {len(chosen.keep)} piece to keep")

plan = wipe.plan(chosen.wipe, layer.size, keep=chosen.keep)
(x0, y0), (x1, y1) = plan.strokes[0][0], plan.strokes[0][-1]
print(
    f"{len(plan.strokes)} stroke in {plan.duration:.0f} s, from ({x0:.2f}, {y0:.2f}) to ({x1:.2f}, {y1:.2f})"
)
print(f"places that no stroke wipes: {len(plan.left)}")

# the board lies in front of the arm, 15 cm up: x to the right, y towards the base, z down
T_base_board = np.array(
    [[0.0, -1.0, 0.0, 0.75], [-1.0, 0.0, 0.0, 0.25], [0.0, 0.0, -1.0, 0.15], [0, 0, 0, 1.0]]
)
arm = robots.load("kuka_lbr_iiwa7")
print("the arm gets there:", wipe.reachable(arm, plan, T_base_board).ok)

# felt with 450 Pa along the legs that slide
before = layer.amount.copy()
for leg in plan.legs:
    if leg.phase == "slide":
        for a, b in itertools.pairwise(np.linspace(leg.start, leg.end, 500)):
            layer.rub(b[:2], plan.angle, (plan.eraser.width, plan.eraser.length), 450.0, (b - a)[:2])
left = [100.0 * layer.amount[rows].sum() / before[rows].sum() for rows in (slice(0, 175), slice(175, 350))]
print(f"left: {left[0]:.0f} % of the red ink, {left[1]:.0f} % of the black ink")
