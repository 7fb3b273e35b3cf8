"""An arm as a C++ header: it compiles, and every number in it is the arm's own to the bit."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path

import pytest

from palpate import robots
from palpate.arm import Arm, Effort
from palpate.errors import ArmError

CORE = Path(__file__).resolve().parents[2] / "core" / "include"
COMPILER = shutil.which("c++")

PRINT = r"""
#include "first.hpp"
#include "second.hpp"
#include <cstdio>
void show(const palpate::ArmDescription& d) {
  const palpate::Arm checked(d);
  std::printf("%d %d", checked.n(), checked.has_dynamics());
  auto all = [](const auto& list) { for (double x : list) std::printf(" %a", x); };
  for (int i = 0; i < d.n; ++i) {
    const auto& j = d.joints[static_cast<unsigned>(i)];
    const auto& f = j.friction;
    std::printf(" %d", j.prismatic);
    all(j.T_parent_joint.R), all(j.T_parent_joint.p), all(j.axis), all(j.com), all(j.inertia);
    for (double x : {j.mass, j.rotor_inertia, f.coulomb, f.viscous, f.offset, f.static_, f.stribeck_velocity,
                     f.load, f.sign_velocity, j.lower, j.upper, j.max_velocity, j.max_effort,
                     j.position_resolution, j.position_std,
                     j.velocity_std, j.torque_resolution, j.torque_std, j.torque_gain_std, j.effort_gain})
      std::printf(" %a", x);
  }
  all(d.gravity), all(d.T_last_tip.R), all(d.T_last_tip.p), all(d.grasp);
  std::printf("\n");
}
static_assert(first.n == 6);
int main() { show(first); show(second); }
"""


def figures(arm: Arm) -> list[float]:
    def known(value: float | None) -> float:
        return math.nan if value is None else value

    out: list[float] = [arm.n, arm.has_dynamics]
    for j, gain in zip(arm.joints, arm.effort.gain(arm.n), strict=True):
        f, x, s = j.friction, j.limits, j.sensing
        out += [
            j.kind == "prismatic",
            *j.T_parent_joint[:3, :3].flat,
            *j.T_parent_joint[:3, 3],
            *j.axis,
            *j.com,
        ]
        out += [j.inertia[i, k] for i, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
        out += [
            j.mass,
            j.rotor_inertia,
            f.coulomb,
            f.viscous,
            f.offset,
            known(f.static),
            known(f.stribeck_velocity),
        ]
        out += [
            f.load,
            f.sign_velocity,
            x.lower,
            x.upper,
            x.velocity,
            x.effort,
            s.position_resolution,
            s.position_std,
        ]
        out += [known(s.velocity_std), s.torque_resolution, s.torque_std, s.torque_gain_std, gain]
    return [*out, *arm.gravity, *arm.T_last_tip[:3, :3].flat, *arm.T_last_tip[:3, 3], *arm.grasp]


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
def test_header_holds_the_arm_to_the_bit(tmp_path):
    first = robots.load("abb_irb2400_16").replace(
        effort=Effort.current([0.1 + i / 7 for i in range(6)], -101)
    )
    second = Arm.from_dh([0.1, 0.2], [0.3, 0.4], [0.5, 0.6], prismatic=[False, True], effort=Effort.torque())
    second = second.replace(joints=(second.joints[0].replace(name="odd */ name \\\n"), second.joints[1]))
    (tmp_path / "first.hpp").write_text(first.to_header("first"))
    (tmp_path / "second.hpp").write_text(second.to_header("second"))
    (tmp_path / "main.cpp").write_text(PRINT)
    command = [COMPILER, "-std=c++20", "-Wall", "-Wextra", "-Werror", f"-I{CORE}", "main.cpp", "-o", "main"]
    subprocess.run(command, cwd=tmp_path, check=True)
    lines = subprocess.run(
        [tmp_path / "main"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    for arm, line in zip((first, second), lines, strict=True):
        read = [float.fromhex(word) for word in line.split()]
        expected = figures(arm)
        assert len(read) == len(expected)
        assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(read, expected, strict=True))


def test_the_example_uses_the_header_that_is_written():
    kept = Path(__file__).resolve().parents[2] / "examples" / "cpp" / "justina_left_arm.hpp"
    assert kept.read_text("utf-8") == robots.load("justina_left_arm").to_header()


def test_header_name():
    arm = robots.load("kuka_lbr_iiwa7")
    assert "inline constexpr palpate::ArmDescription kuka_lbr_iiwa7{" in arm.to_header()
    for wrong in ("", "7dof", "a b", "a-b", "double", "palpate", "_x", "a__b", "é"):
        with pytest.raises(ArmError, match="cannot name a C.. constant"):
            arm.to_header(wrong)
    with pytest.raises(ArmError, match="cannot name a C.. constant"):
        arm.replace(name="my arm").to_header()


def test_header_needs_the_effort_declared():
    with pytest.raises(ArmError, match="not declared"):
        robots.load("kuka_lbr_iiwa7").replace(effort=Effort.undeclared()).to_header()
