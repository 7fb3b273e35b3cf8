"""ABAG, Cartesian velocity by force and impedance in Python; their laws are proved in core/tests."""

from __future__ import annotations

import numpy as np
import pytest

import palpate as pp
from palpate import robots
from palpate.errors import InputError
from palpate.simulate import Plant

BENT = np.array([-0.43, 0.36, 0.31, -1.48, 0.68, 1.49, 0.0])


@pytest.fixture(scope="module")
def arm():
    return robots.load("kuka_lbr_iiwa7")


def pose(arm, q):
    T = arm.forward_kinematics(q[None])[0]
    return T[:3, :3] @ arm.grasp + T[:3, 3], T[:3, :3]


# -- ABAG -----------------------------------------------------------------


def test_abag_is_the_law():
    """The four lines of the paper, written out."""
    rng = np.random.default_rng(0)
    errors = rng.normal(0.3, 1.0, 2000)
    e_bar = b = g = 0.0
    wanted = []
    for e in errors:
        e_bar = 0.75 * e_bar + 0.25 * np.sign(e)
        b = np.clip(b + 0.001 * (abs(e_bar) > 0.75) * np.sign(e_bar), -1, 1)
        g = np.clip(g + 0.001 * np.sign(abs(e_bar) - 0.5), 0, 1)
        wanted.append((e_bar, b, g, np.clip(b + g * np.sign(e), -1, 1)))
    abag = pp.Abag()
    found = abag.run(errors)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    assert abag.state == pytest.approx(found[-1])
    single = pp.Abag()
    assert [single.step(e) for e in errors[:50]] == list(found[:50, 3])


def test_the_negative_gain_is_an_option():
    noise = np.tile([1.0, -1.0], 500)
    assert pp.Abag().run(noise)[:, 2].min() == 0.0
    assert pp.Abag(negative_gain=True).run(noise)[:, 2].min() == -1.0


def test_parameter_sets():
    assert pp.AbagParameters.whiteboard().alpha == 0.75
    kinova = pp.AbagParameters.kinova()
    assert (kinova.theta_b, kinova.delta_g, kinova.period) == (4.1e-4, 2.6e-3, 0.001)
    assert kinova.at(0.008).alpha == pytest.approx(0.9**8)
    with pytest.raises(InputError, match="alpha = 1: expected a number from 0 to below 1"):
        pp.Abag(pp.AbagParameters(alpha=1.0))
    with pytest.raises(ValueError, match="unknown option 'alhpa'; choose from alpha, theta_b"):
        pp.AbagParameters(alhpa=0.5)


# -- Cartesian velocity ---------------------------------------------------


def drive(arm, controller, target, seconds, *, push=None):
    """Simulate; rows of (time, tool position, speed, |F|, |T|, yielding)."""
    plant = Plant(arm)
    plant.reset(BENT)
    rows = []
    for k in range(round(seconds / controller.period)):
        time = k * controller.period
        pushed = np.zeros(3) if push is None else np.asarray(push(time), dtype=float)
        plant.push("grasp", pushed)
        command = controller.step(target, plant.q, plant.dq, force=pushed)
        plant.step(command.torque, round(controller.period * 1e9))
        x, _ = pose(arm, plant.q)
        speed = np.linalg.norm(command.velocity)
        norms = np.linalg.norm(command.force), np.linalg.norm(command.moment)
        rows.append((time, *x, speed, *norms, command.yielding))
    return np.array(rows), plant


def test_reaches_the_goal_in_mujoco_within_its_bounds(arm):
    x, R = pose(arm, BENT)
    goal = x + np.array([0.1, -0.15, -0.1])
    run, plant = drive(arm, pp.CartesianVelocity(arm, 0.004), pp.CartesianTarget(goal, R), 14.0)
    end, turned = pose(arm, plant.q)
    assert np.linalg.norm(end - goal) < 0.002
    assert np.linalg.norm(turned - R) < 0.01
    assert run[:, 5].max() <= 5.0
    assert run[:, 6].max() <= 2.0
    assert run[:, 4].max() < 0.06
    middle = (run[:, 0] > 1.5) & (np.linalg.norm(run[:, 1:4] - goal, axis=1) > 0.1)
    assert run[middle, 4].mean() == pytest.approx(0.05, abs=0.006)


def test_a_push_leads_to_yielding_not_to_more_force(arm):
    x, R = pose(arm, BENT)
    target = pp.CartesianTarget(x + np.array([0.0, -0.3, 0.0]), R)
    run, _ = drive(
        arm,
        pp.CartesianVelocity(arm, 0.004),
        target,
        4.0,
        push=lambda t: (0.0, 30.0, 0.0) if 2.0 <= t < 2.5 else (0, 0, 0),
    )
    during = (run[:, 0] >= 2.0) & (run[:, 0] < 2.5)
    assert run[during, 7].all()
    assert run[during, 5].max() == 0.0
    assert run[during][-1, 2] > run[during][0, 2] + 0.1  # it gives way
    assert run[:, 4].max() < 1.0  # and is not thrown
    assert run[-1, 7] == 0.0  # and goes on
    assert run[:, 5].max() <= 5.0


def test_published_and_corrected_bounds(arm):
    """Held fast, three published ABAGs command sqrt(3) times the bound."""
    x, R = pose(arm, BENT)
    target = pp.CartesianTarget(x + 0.3, R)
    published = pp.CartesianVelocityOptions.published("per_axis")
    corrected = pp.CartesianVelocityOptions(**{**published.options(), "errata": pp.VelocityErrata()})
    N = 2000
    still = np.tile(BENT, (N, 1)), np.zeros((N, 7)), np.zeros((N, 3))
    for options, bound in ((published, 5.0 * np.sqrt(3.0)), (corrected, 5.0)):
        _, wrench = pp.CartesianVelocity(arm, 0.008, options).run(target, *still)
        assert np.linalg.norm(wrench[:, :3], axis=1).max() == pytest.approx(bound, abs=1e-9)


def test_run_is_step(arm):
    x, R = pose(arm, BENT)
    target = pp.CartesianTarget(x + np.array([0.1, 0.0, 0.0]), R, normal_force=2.0)
    rng = np.random.default_rng(1)
    q, dq, force = BENT + 0.05 * rng.normal(size=(50, 7)), rng.normal(size=(50, 7)), rng.normal(size=(50, 3))
    torque, wrench = pp.CartesianVelocity(arm, 0.004).run(target, q, dq, force)
    single = pp.CartesianVelocity(arm, 0.004)
    for i in range(50):
        command = single.step(target, q[i], dq[i], force=force[i])
        np.testing.assert_array_equal(command.torque, torque[i])
        np.testing.assert_array_equal(np.concatenate((command.force, command.moment)), wrench[i])


def test_moving_in_the_plane_neither_lifts_nor_tips_the_tool(arm):
    """The tool's acceleration under the command and the surface's force, with and without the decoupling."""
    x, R = pose(arm, BENT)
    target = pp.CartesianTarget(x + np.array([0.2, -0.1, 0.0]), R, speed=0.3, normal_force=2.5)
    felt = np.array([0.7, 0.4, 2.5])  # friction, and just the force that is wanted
    M, g = arm.mass_matrix(BENT), arm.gravity_torque(BENT)
    J = arm.jacobian(BENT, arm.grasp)
    lifted = {}
    for decoupled in (True, False):
        command = pp.CartesianVelocity(arm, 0.004, decoupled=decoupled).step(
            target, BENT, np.zeros(7), force=felt
        )
        assert np.linalg.norm(command.force) <= 5.0 and np.linalg.norm(command.moment) <= 2.0
        acceleration = J @ np.linalg.solve(M, command.torque - g + J[:3].T @ felt)
        assert np.linalg.norm(acceleration[:2]) > 0.1
        lifted[decoupled] = np.abs(acceleration[2:])
    assert lifted[True].max() < 1e-9 and lifted[False].max() > 0.1


def test_without_the_force_nothing_is_pressed(arm):
    x, R = pose(arm, BENT)
    controller = pp.CartesianVelocity(arm, 0.004)
    target = pp.CartesianTarget(x, R, normal_force=3.0)
    assert controller.step(target, BENT, np.zeros(7), force=np.zeros(3)).force[2] == pytest.approx(-3.0)
    lost = controller.step(target, BENT, np.zeros(7))
    assert lost.status == pp.Status.held
    assert not lost.force.any()


def test_a_state_that_is_no_number_floats_the_arm(arm):
    x, R = pose(arm, BENT)
    command = pp.CartesianVelocity(arm, 0.004).step(pp.CartesianTarget(x, R), BENT, np.full(7, np.nan))
    assert command.status == pp.Status.non_finite
    gravity = arm.core.momentum_terms(BENT[None], np.zeros((1, 7)))[2][0]
    np.testing.assert_array_equal(command.torque, gravity)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda arm: pp.CartesianVelocity(arm, -1.0), "period [s] = -1: expected a finite number > 0"),
        (
            lambda arm: pp.CartesianVelocity(arm, 0.004, max_fource=3.0),
            "unknown option 'max_fource'; choose from axes",
        ),
        (lambda arm: pp.CartesianVelocity(arm, 0.004, axes="x"), "axes 'x'; choose from heading, per_axis"),
        (
            lambda arm: pp.CartesianVelocity(arm, 0.004, pp.CartesianVelocityOptions(), max_force=3.0),
            "give options, or max_force, not both",
        ),
        (
            lambda arm: pp.CartesianVelocity(arm, 0.004).step(
                pp.CartesianTarget([0, 0], np.eye(3)), BENT, BENT
            ),
            "position: expected 3 numbers, got 2",
        ),
        (lambda arm: pp.CartesianImpedance(arm, mass=0.0), "mass [kg] = 0: expected a finite number > 0"),
    ],
)
def test_wrong_input_is_one_line(arm, make, message):
    with pytest.raises(InputError) as caught:
        make(arm)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_impedance_grows_without_bound(arm):
    x, R = pose(arm, BENT)
    spring = pp.CartesianImpedance(arm, stiffness=(400.0, 400.0, 400.0))
    _, status, force, _ = spring.step(x + np.array([1.0, 0.0, 0.0]), R, BENT, np.zeros(7))
    assert status == pp.Status.ok
    np.testing.assert_allclose(force, [400.0, 0.0, 0.0], atol=1e-9)
