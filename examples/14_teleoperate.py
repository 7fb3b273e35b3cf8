"""A hand presses a wall through a simulated haptic device and a simulated arm, and feels it without a force sensor.

Needs palpate[teleop]. Prints:

    the wall pushes back with 6.6 N
    the hand feels 99 % of what the tool meets, 5 ms after the touch
"""

from __future__ import annotations

from palpate.teleop.figures import transparency
from palpate.teleop.setups import build

STIFFNESS = 2000.0  # of the wall [N/m]

run = build("wall", stiffness=STIFFNESS).run(seconds=5.5)
felt = transparency(run, stiffness=STIFFNESS)
print(f"the wall pushes back with {felt.force_held:.1f} N")
print(
    f"the hand feels {100.0 * felt.stiffness:.0f} % of what the tool meets, {1e3 * felt.onset:.0f} ms after the touch"
)
