"""Reference arms, written from published figures; each URDF states its sources and is all there is to know.

A card of any of them: ``palpate.robots.load(name).save("arm.yaml")``.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

from ..arm import Arm
from ..errors import ArmError, suggest

_NAMES = (
    "abb_irb2400_16",
    "justina_left_arm",
    "justina_left_arm_box",
    "katana_300_6m180",
    "katana_450_6m90a",
    "kuka_lbr_iiwa14",
    "kuka_lbr_iiwa7",
    "so101",
)


def names() -> tuple[str, ...]:
    """Names of the reference arms."""
    return _NAMES


@cache
def load(name: str) -> Arm:
    """A reference arm by name; the same object every time, since arms are immutable.

    Raises:
        ArmError: no arm of that name; lists the nearest.
    """
    if name not in _NAMES:
        raise ArmError(f"no reference arm {name!r}; {suggest(str(name), _NAMES, 'there are')}")
    return Arm.from_urdf(resources.files(__name__).joinpath(f"{name}.urdf").read_text(encoding="utf-8"))
