"""Identification on simulated arms: what went in must come out, and what cannot be known must be said."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from palpate import Arm, Effort, Friction, Joint, Status, robots
from palpate import weigh as W
from palpate.arm import Sensing
from palpate.errors import InputError, LogError
from palpate.identify import (
    Coupling,
    FrictionModel,
    KnownLoad,
    estimate_load,
    fit,
    fit_bus_drive,
    fit_gains,
    fit_transmission,
    prepare,
)
from palpate.identify.consistent import (
    body,
    consistent,
    link_parameters,
    prior_links,
    pseudo_inertia,
)
from palpate.identify.friction import remembered_sign
from palpate.identify.regress import (
    Builder,
    base_parameters,
    damped,
    least_squares,
    structural_rank,
)
from palpate.logs import Log, Signal
from palpate.logs.noise import beside_rounding

pytest.importorskip("scipy", reason="palpate[identify] is not installed")

RATE = 200.0


def truth() -> Arm:
    """The iiwa with friction and rotors."""
    arm = robots.load("kuka_lbr_iiwa7")
    sizes = np.linspace(6.0, 0.8, arm.n)
    joints = tuple(
        j.replace(
            rotor_inertia=0.3 / (i + 1),
            friction=Friction(
                coulomb=sizes[i], viscous=0.8 * sizes[i], offset=0.1 * sizes[i], sign_velocity=1e-3
            ),
        )
        for i, j in enumerate(arm.joints)
    )
    return arm.replace(joints=joints, effort=Effort.torque())


def motion(n: int, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    q, dq, ddq = np.zeros((3, len(t), n))
    for k in range(1, 6):
        w = 2 * np.pi * 0.1 * k
        a, b = rng.normal(0.0, 0.5 / k, (2, n))
        q += a * np.sin(w * t)[:, None] + b * np.cos(w * t)[:, None]
        dq += w * (a * np.cos(w * t)[:, None] - b * np.sin(w * t)[:, None])
        ddq -= w * w * (a * np.sin(w * t)[:, None] + b * np.cos(w * t)[:, None])
    return t, q, dq, ddq


def simulate(
    arm: Arm, seconds: float = 20.0, seed: int = 0, noise: float = 0.02, load: np.ndarray | None = None
) -> Log:
    t, q, dq, ddq = motion(arm.n, seconds, seed)
    tau = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    if load is not None:
        tau += arm.regressor(q, dq, ddq)[:, :, -10:] @ load
    rng = np.random.default_rng(seed + 100)
    tau += noise * rng.standard_normal(tau.shape)
    return Log(
        time_ns=np.rint(t * 1e9).astype(np.int64),
        position=q,
        velocity=dq,
        effort=tau / arm.effort.gain(arm.n),
        joint_names=arm.joint_names,
        meta={"effort_unit": "A" if arm.effort.kind == "current" else "N m"},
    )


def perturbed(arm: Arm, seed: int = 3) -> Arm:
    """Same kinematics, wrong masses, no friction: what a URDF knows."""
    rng = np.random.default_rng(seed)
    joints = []
    for j in arm.joints:
        scale = float(np.exp(0.3 * rng.standard_normal()))
        joints.append(
            j.replace(mass=j.mass * scale, inertia=j.inertia * scale, rotor_inertia=0.0, friction=Friction())
        )
    return arm.replace(joints=tuple(joints))


# -- data -------------------------------------------------------------------------------------------------------------


def test_prepare_copes_with_jitter_repeats_and_gaps():
    arm = truth()
    log = simulate(arm, 20.0)
    rng = np.random.default_rng(1)
    keep = np.sort(rng.choice(len(log), len(log) - 200, replace=False))
    keep = keep[(keep < 1500) | (keep > 1700)]  # one second is missing
    keep = np.insert(keep, 50, keep[50])  # and one row came twice
    rough = dataclasses.replace(
        log,
        time_ns=log.time_ns[keep],
        position=log.position[keep],
        velocity=None,
        effort=log.effort[keep],
        repair=None,
    )
    data = prepare(rough)
    assert len(data.segments) == 2
    assert any("repeated" in note for note in data.origins[0].notes)
    assert data.origins[0].velocity == "differentiated"
    t, q, dq, ddq = motion(arm.n, 20.0, 0)
    for name, true, most in (("q", q, 1e-3), ("dq", dq, 1e-2), ("ddq", ddq, 0.15)):
        wanted = np.column_stack([np.interp(data.time, t, c) for c in true.T])
        assert np.abs(getattr(data, name) - wanted).max() < most, name


def test_prepare_refuses_a_velocity_that_is_not_the_derivative():
    log = simulate(truth(), 10.0)
    wrong = dataclasses.replace(log, velocity=log.velocity * 57.3)
    data = prepare(wrong)
    assert data.origins[0].velocity == "differentiated"
    assert any("differs" in note for note in data.origins[0].notes)
    np.testing.assert_allclose(data.dq, prepare(log).dq, atol=5e-3)
    assert prepare(wrong, velocity=True).origins[0].velocity == "measured"


@pytest.mark.parametrize("rows", [1, 2, 20])
def test_too_short_logs_say_so(rows):
    with pytest.raises(LogError, match="usable stretch"):
        fit(truth(), simulate(truth(), 10.0)[:rows])


def test_prepare_complains():
    log = simulate(truth(), 10.0)
    with pytest.raises(InputError, match="cutoff"):
        prepare(log, cutoff=0.0)
    with pytest.raises(InputError, match="weights"):
        prepare([log, log], weights=[1.0])
    with pytest.raises(InputError, match="no signal 'sensor'"):
        prepare(log, effort="sensor")
    with pytest.raises(InputError, match="at least one"):
        prepare([])
    with pytest.raises(InputError, match="has joints"):
        prepare([log, log.select(log.joint_names[:3])])


# -- friction ---------------------------------------------------------------------------------------------------------


def test_the_sign_remembers():
    dq = np.r_[np.full(50, 1.0), np.zeros(50), np.full(50, -1.0), np.zeros(50)][:, None]
    z = remembered_sign(dq, 1e-2, np.array([1e-3, 0.1]))
    assert z.shape == (2, 200, 1)
    np.testing.assert_allclose(z[0, 60:100, 0], 1.0)
    np.testing.assert_allclose(z[0, 160:, 0], -1.0)
    # Dahl: exp(-distance / x_0) of the way is left after a reversal
    np.testing.assert_allclose(z[1, 109, 0], -1.0 + 2.0 * np.exp(-0.1 / 0.1), rtol=1e-9)
    assert np.abs(z).max() <= 1.0


def test_the_sign_does_not_depend_on_time():
    rng = np.random.default_rng(0)
    dq = rng.standard_normal((400, 2))
    a = remembered_sign(dq, 1e-2, np.array([3e-3]))
    b = remembered_sign(0.1 * dq, 1e-1, np.array([3e-3]))
    np.testing.assert_allclose(a, b, atol=1e-12)


# -- solvers ----------------------------------------------------------------------------------------------------------


def test_pseudo_inertia_round_trip():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((20, 3)) * 0.1 + [0.1, 0.2, -0.3]
    weights = rng.uniform(0.1, 1.0, 20)
    mass = weights.sum()
    com = weights @ points / mass
    r = points - com
    inertia = sum(w * (x @ x * np.eye(3) - np.outer(x, x)) for w, x in zip(weights, r, strict=True))
    pi = link_parameters(mass, com, inertia)
    homogeneous = np.column_stack([points, np.ones(20)])
    np.testing.assert_allclose(
        pseudo_inertia(pi), (homogeneous * weights[:, None]).T @ homogeneous, atol=1e-12
    )
    back = body(pi)
    np.testing.assert_allclose(back[0], mass)
    np.testing.assert_allclose(back[1], com)
    np.testing.assert_allclose(back[2], inertia, atol=1e-12)


def test_without_data_the_prior_stays():
    arm = truth()
    prior = prior_links(arm)
    p = 10 * arm.n + 2
    H, g = np.zeros((p, p)), np.zeros(p)
    H[-1, -1] = H[-2, -2] = 1.0
    g[-2:] = 3.0, -1.0
    found = consistent(H, g, prior, np.array([p - 2]), np.r_[np.zeros(p - 2), 1.0, 0.0])
    np.testing.assert_allclose(found.phi[: 10 * arm.n].reshape(-1, 10), prior, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.phi[-2:], [3.0, -1.0], atol=0.02)
    assert np.abs(found.divergence).max() < 1e-9


def test_data_that_want_impossible_links_get_possible_ones():
    arm = truth()
    prior = prior_links(arm)
    p = 10 * arm.n
    wish = prior.copy()
    wish[2, 0] = -1.0  # a negative mass
    wish[4, 4] = -0.1  # a negative moment of inertia
    H = 1e6 * np.eye(p)
    found = consistent(H, H @ wish.ravel(), prior, np.zeros(0, dtype=int), prior.ravel())
    links = found.phi.reshape(-1, 10)
    assert all(np.linalg.eigvalsh(pseudo_inertia(pi)).min() > 0.0 for pi in links)
    assert 0.0 < links[2, 0] < 0.01
    np.testing.assert_allclose(links[0], wish[0], atol=1e-3)


def test_consistent_agrees_with_a_general_minimiser():
    from scipy.optimize import minimize

    rng = np.random.default_rng(0)
    prior = link_parameters(2.0, np.array([0.1, 0.0, 0.05]), np.diag([0.02, 0.03, 0.025]))[None]
    A = rng.standard_normal((8, 11))
    y = A @ np.r_[prior[0] * 1.3, 0.7] + 0.1 * rng.standard_normal(8)
    H, g = A.T @ A, A.T @ y
    found = consistent(H, g, prior, np.array([10]), np.r_[prior[0], 1.0], barrier=1e-6)
    P0 = pseudo_inertia(prior[0])

    def cost(x: np.ndarray) -> float:
        P = pseudo_inertia(x[:10])
        if np.linalg.eigvalsh(P).min() <= 0.0 or x[10] <= 0.0:
            return 1e9
        return 0.5 * x @ H @ x - g @ x + np.trace(np.linalg.solve(P0, P)) - np.linalg.slogdet(P)[1]

    best = cost(found.phi)
    for _ in range(200):  # no neighbour is better
        assert cost(found.phi + 1e-4 * rng.standard_normal(11)) >= best - 1e-9
    other = minimize(cost, np.r_[prior[0], 1.0], method="Nelder-Mead", options={"maxiter": 4000})
    assert best <= other.fun + 1e-6


def test_consistent_complains():
    prior = prior_links(truth())
    p = prior.size
    with pytest.raises(InputError, match="weight"):
        consistent(np.eye(p), np.zeros(p), prior, np.zeros(0, dtype=int), prior.ravel(), gamma=0.0)
    with pytest.raises(InputError, match="no body"):
        consistent(np.eye(p), np.zeros(p), -prior, np.zeros(0, dtype=int), prior.ravel())


def test_methods_and_base_parameters_on_clean_data():
    arm = truth()
    data = prepare(simulate(arm, 20.0, noise=0.0))
    model = FrictionModel(presliding=(1e-5,))
    from palpate.identify.friction import FrictionShape

    builder = Builder(arm, data, data.effort)
    problem = builder.problem(model, FrictionShape((1e-5,) * arm.n, (0.1,) * arm.n))
    rms = np.sqrt(np.mean(np.square(problem.y), axis=0))
    for method in ("ols", "wls", "irls"):
        solution = least_squares(problem, method=method)
        left = problem.y - problem.predict(solution.phi)
        assert np.all(np.sqrt(np.mean(np.square(left), axis=0)) < 0.03 * rms), method
    base = base_parameters(problem, solution, structural_rank=structural_rank(arm, model))
    assert base.rank == base.structural_rank == np.linalg.matrix_rank(base.combination)
    # the groups of the solution are those of the truth
    phi = np.zeros(len(problem.parameters))
    phi[: 10 * arm.n] = np.concatenate([link_parameters(j.mass, j.com, j.inertia) for j in arm.joints])
    phi[10 * arm.n : 11 * arm.n] = [j.rotor_inertia for j in arm.joints]
    for k, p in enumerate(problem.parameters):
        if p.kind in ("coulomb", "viscous", "offset"):
            phi[k] = getattr(arm.joints[p.index].friction, p.kind)
    torque = np.abs(problem.y - problem.predict(phi)).max(axis=0)
    assert np.all(torque < 0.6 * np.abs(problem.y).max(axis=0))
    np.testing.assert_allclose(
        base.value, base.combination @ phi, atol=0.05 * np.abs(base.combination @ phi).max()
    )
    strong = damped(problem, phi, 1e9)
    np.testing.assert_allclose(strong, phi, atol=1e-6)
    with pytest.raises(InputError, match="damping"):
        damped(problem, phi, 0.0)
    with pytest.raises(InputError, match="shape"):
        damped(problem, phi[1:], 1.0)
    with pytest.raises(InputError, match="method"):
        least_squares(problem, method="lsq")


# -- fit --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result():
    arm = truth()
    return fit(perturbed(arm), [simulate(arm, 20.0, seed=k) for k in range(3)], friction="coulomb")


def test_the_arm_comes_back(result):
    arm = truth()
    log = simulate(arm, 15.0, seed=50)
    prediction = result.predict(log)
    error = (prediction.measured - prediction.predicted)[prediction.known.all(axis=1)]
    assert np.all(np.sqrt(np.mean(np.square(error), axis=0)) < 0.05 * prediction.measured.std(axis=0) + 0.1)
    _, q, dq, ddq = motion(arm.n, 10.0, 77)
    want, got = arm.inverse_dynamics(q, dq, ddq), result.arm.inverse_dynamics(q, dq, ddq)
    assert np.sqrt(np.mean(np.square(got - want))) < 0.03 * np.sqrt(np.mean(np.square(want)))
    for j, true in zip(result.arm.joints, arm.joints, strict=True):
        assert j.friction.coulomb == pytest.approx(true.friction.coulomb, rel=0.1)
        assert j.friction.viscous == pytest.approx(true.friction.viscous, rel=0.1)


def test_the_result_is_complete_and_frozen(result):
    n = result.arm.n
    assert result.held_out is not None
    assert result.held_out.what == "each of 3 logs from the others"
    assert result.base.rank == result.base.structural_rank
    assert result.unseen == ()
    assert len(result.parameters) == len(result.phi) == 10 * n + n + 3 * n
    assert all(np.isfinite(e.value) and e.std > 0.0 for e in result.parameters)
    assert result.arm.provenance["identified"].startswith("3 logs")
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.cutoff = 3.0
    text = result.summary()
    for word in (*result.arm.joint_names, "held out", "base parameters"):
        assert word in text


def test_friction_lies_within_its_interval(result):
    values = {e.name: e for e in result.parameters}
    z = []
    for j in truth().joints:
        for term in ("viscous", "offset"):
            e = values[f"{j.name}.{term}"]
            z.append((e.value - getattr(j.friction, term)) / e.std)
    assert np.sqrt(np.mean(np.square(z))) < 3.0


def test_load_and_false_load(result):
    arm = truth()
    held = link_parameters(1.2, np.array([0.05, -0.03, 0.1]), 0.005 * np.eye(3))
    found = estimate_load(result, simulate(arm, 10.0, seed=9, load=held))
    assert found.mass == pytest.approx(1.2, rel=0.04)
    assert found.interval[0] < 1.2 < found.interval[1]
    np.testing.assert_allclose(found.com, [0.05, -0.03, 0.1], atol=0.02)
    nothing = estimate_load(result, simulate(arm, 10.0, seed=10))
    assert abs(nothing.mass) < 0.06
    assert nothing.interval[0] < 0.0 < nothing.interval[1]
    assert np.isnan(nothing.com).all()
    point = estimate_load(result, simulate(arm, 10.0, seed=9, load=held), parameters=4)
    assert point.mass == pytest.approx(1.2, rel=0.04)
    with pytest.raises(InputError, match="10, 4 or 1"):
        estimate_load(result, simulate(arm, 10.0), parameters=3)


def aged(log: Log, scale: float = 1.0, friction: float = 1.0) -> Log:
    """The log of a day on which the drives gave `scale` of the torque and friction was `friction` of its size."""
    arm = truth()
    more = (friction - 1.0) * arm.friction_torque(log.velocity)
    return dataclasses.replace(log, effort=(log.effort + more / arm.effort.gain(arm.n)) * scale)


def test_days_that_differ_widen_the_interval(result):
    arm = truth()
    assert np.all(
        (result.scale_std > 0.009) & (result.scale_std < 0.012)
    )  # 2 % for one log, three that agree
    assert np.all((result.drift_std > 0.04) & (result.drift_std < 0.06))  # 10 % for one log
    single = fit(perturbed(arm), simulate(arm, 20.0), friction="coulomb", cross_validate=False)
    np.testing.assert_array_equal(single.scale_std, 0.02)
    np.testing.assert_array_equal(single.drift_std, 0.1)
    days = (0.94, 1.06, 1.0)
    logs = [aged(simulate(arm, 20.0, seed=k), scale=s) for k, s in enumerate(days)]
    weak = fit(perturbed(arm), logs, friction="coulomb")
    assert np.all(weak.scale_std > 0.03)
    logs = [aged(simulate(arm, 20.0, seed=k), friction=s) for k, s in enumerate((0.6, 1.4, 1.0))]
    warm = fit(perturbed(arm), logs, friction="coulomb")
    assert np.all(warm.drift_std > 1.5 * result.drift_std)
    held = link_parameters(1.2, np.array([0.05, -0.03, 0.1]), 0.005 * np.eye(3))
    log = simulate(arm, 10.0, seed=9, load=held)
    assert estimate_load(weak, log).mass_std > 1.5 * estimate_load(result, log).mass_std
    calm = estimate_load(result, log, drift=0.0)
    assert calm.mass_std < estimate_load(result, log).mass_std


def test_gains_say_that_a_drive_may_give_less_under_load():
    arm = truth()
    gains = np.array([11.0, 12.0, 10.0, 9.5, 8.0, 7.0, 6.0])
    driven = arm.replace(effort=Effort.current(gains))
    held = link_parameters(3.0, np.array([0.1, 0.05, 0.1]), 0.01 * np.eye(3))
    free = simulate(driven, 20.0, seed=0)
    loaded = simulate(driven, 20.0, seed=1, load=held)
    weaker = dataclasses.replace(loaded, effort=0.98 * loaded.effort)
    found = fit_gains(perturbed(arm), free, weaker, KnownLoad(3.0), friction="coulomb")
    assert np.abs(found.gain / gains - 1.0).max() > 0.015
    assert np.all(np.abs(found.gain - gains) < 3.0 * found.std)


def test_a_spring_comes_back_and_is_no_part_of_the_card():
    arm = truth()
    log = simulate(arm, 20.0)
    stiffness = np.array([0.0, 0.0, 4.0, 0.0, 2.0, 0.0, 1.0])
    log = dataclasses.replace(log, effort=log.effort + stiffness * log.position)
    for bad in ((7,), (-1,)):
        with pytest.raises(InputError, match="springs"):
            fit(arm, log, friction=FrictionModel(springs=bad))
    found = fit(perturbed(arm), log, friction=FrictionModel(springs=(6, 2, 4)), cross_validate=False)
    springs = {e.name.split(".")[0]: e.value for e in found.parameters if e.name.endswith(".stiffness")}
    assert springs == pytest.approx({arm.joints[k].name: stiffness[k] for k in (2, 4, 6)}, rel=0.05)
    assert found.base.rank == found.base.structural_rank
    assert "left out" in found.arm.provenance["springs"]
    rigid = fit(perturbed(arm), log, friction="coulomb", cross_validate=False)
    assert found.residuals.overall < 0.5 * rigid.residuals.overall
    assert "springs" not in rigid.arm.provenance


def test_gains_from_a_known_load():
    arm = truth()
    gains = np.array([11.0, 12.0, 10.0, 9.5, 8.0, 7.0, 6.0])
    driven = arm.replace(effort=Effort.current(gains))
    held = link_parameters(3.0, np.array([0.1, 0.05, 0.1]), 0.01 * np.eye(3))
    free = [simulate(driven, 20.0, seed=k, noise=0.05) for k in range(2)]
    loaded = simulate(driven, 20.0, seed=1, noise=0.05, load=held)
    found = fit_gains(perturbed(arm), free, loaded, KnownLoad(3.0), friction="coulomb")
    np.testing.assert_allclose(found.gain, gains, rtol=0.04)
    assert np.all(found.std > 0.0)
    np.testing.assert_allclose(found.arm.effort.gain(arm.n), found.gain)
    with pytest.raises(InputError, match="only the ratios"):
        fit_gains(arm, free, [], KnownLoad(3.0))
    with pytest.raises(InputError, match="positive mass"):
        KnownLoad(0.0)


def test_transmission_from_a_joint_torque_sensor():
    arm = truth()
    _, q, dq, ddq = motion(arm.n, 20.0, 0)
    log = simulate(arm, 20.0, seed=0)
    sensor = Signal(
        log.time_ns,
        arm.replace(joints=tuple(j.replace(rotor_inertia=0.0) for j in arm.joints)).inverse_dynamics(
            q, dq, ddq
        ),
        "N m",
    )
    log = dataclasses.replace(log, signals={"sensor": sensor})
    found = fit_transmission(arm, log, reference="sensor", friction="coulomb")
    assert np.all(found.residuals.rms < 0.1 * np.array([j.friction.coulomb for j in arm.joints]))
    assert found.reverses.all()
    values = {e.name: e.value for e in found.parameters}
    for j in arm.joints:
        assert values[f"{j.name}.coulomb"] == pytest.approx(j.friction.coulomb, rel=0.1)
        assert values[f"{j.name}.rotor_inertia"] == pytest.approx(j.rotor_inertia, abs=0.05)
    np.testing.assert_allclose(found.test(log).rms, found.residuals.rms, rtol=1e-6)


def test_drives_of_one_make_share_their_rotor_inertia():
    arm = truth()
    arm = arm.replace(joints=tuple(j.replace(rotor_inertia=0.2) for j in arm.joints))
    t, q, dq, ddq = motion(arm.n, 20.0, 0)
    q[:, 3], dq[:, 3], ddq[:, 3] = 0.1 * t - 1.0, 0.1, 0.0  # this one never accelerates
    tau = arm.inverse_dynamics(q, dq, ddq)
    noise = 0.02 * np.random.default_rng(4).standard_normal(tau.shape)
    time_ns = np.rint(t * 1e9).astype(np.int64)
    log = Log(
        time_ns=time_ns,
        position=q,
        velocity=dq,
        effort=tau + arm.friction_torque(dq) + noise,
        joint_names=arm.joint_names,
        signals={"sensor": Signal(time_ns, tau - 0.2 * ddq, "N m")},
        meta={"effort_unit": "N m"},
    )
    name = f"{arm.joints[3].name}.rotor_inertia"
    for alike, wanted in (((), 0.0), (((1, 2, 3, 4), (5, 6)), 0.2)):
        found = fit_transmission(arm, log, reference="sensor", friction="coulomb", alike=alike)
        values = {e.name: e.value for e in found.parameters}
        assert values[name] == pytest.approx(wanted, abs=0.03)
    for bad in (((0, 1), (1, 2)), ((0, 7),)):
        with pytest.raises(InputError, match="different joints from 0 to 6"):
            fit_transmission(arm, log, reference="sensor", alike=bad)


def test_couplings():
    arm = truth()
    log = simulate(arm, 20.0)
    extra = log.velocity[:, 4] + log.velocity[:, 5]
    effort = log.effort.copy()
    effort[:, [4, 5]] += (2.0 * np.tanh(extra / 1e-3) + 0.5 * extra)[:, None]
    log = dataclasses.replace(log, effort=effort)
    found = fit(perturbed(arm), log, friction="coulomb", couplings=[Coupling((4, 5))], cross_validate=False)
    values = {e.name.split(".")[1]: e.value for e in found.parameters if "+" in e.name}
    assert values["coulomb"] == pytest.approx(2.0, rel=0.15)
    assert values["viscous"] == pytest.approx(0.5, rel=0.4)
    with pytest.raises(InputError, match="joints 0 to 6"):
        fit(arm, log, friction="coulomb", couplings=[Coupling((4, 9))])
    with pytest.raises(InputError, match="different joints"):
        Coupling((4, 4))


# -- bad input --------------------------------------------------------------------------------------------------------


def test_bad_input_gets_a_message_and_no_number():
    arm = truth()
    log = simulate(arm, 10.0)
    with pytest.raises(InputError, match="does not say what its effort is"):
        fit(arm.replace(effort=Effort.undeclared()), log)
    with pytest.raises(InputError, match="is a torque"):
        fit(arm.replace(effort=Effort.current(1.0)), log)
    with pytest.raises(InputError, match="is a current"):
        fit(arm, dataclasses.replace(log, meta={"effort_unit": "A"}))
    degrees = dataclasses.replace(log, position=np.rad2deg(log.position), velocity=np.rad2deg(log.velocity))
    with pytest.raises(InputError, match="degrees"):
        fit(arm, degrees)
    still = dataclasses.replace(
        log, position=np.zeros_like(log.position), velocity=np.zeros_like(log.velocity)
    )
    with pytest.raises(LogError, match="no joint"):
        fit(arm, still)
    with pytest.raises(InputError, match="friction must be"):
        fit(arm, log, friction="dry")
    with pytest.raises(InputError, match="method must be"):
        fit(arm, log, method="lmi")
    with pytest.raises(InputError, match="joints"):
        fit(arm, log.select(log.joint_names[:4]))


def test_what_was_not_seen_is_said():
    arm = truth()
    t, q, dq, ddq = motion(arm.n, 20.0, 0)
    q[:, 2], dq[:, 2], ddq[:, 2] = 0.3, 0.0, 0.0  # never moves
    q[:, 3], dq[:, 3], ddq[:, 3] = 0.05 * t, 0.05, 0.0  # never reverses
    tau = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    log = Log(
        time_ns=np.rint(t * 1e9).astype(np.int64),
        position=q,
        velocity=dq,
        effort=tau,
        joint_names=arm.joint_names,
        meta={"effort_unit": "N m"},
    )
    found = fit(perturbed(arm), log, friction="coulomb", cross_validate=False)
    text = "\n".join(found.unseen)
    assert f"{arm.joint_names[2]} moves by" in text
    assert f"{arm.joint_names[3]} never reverses" in text
    assert "combinations of rigid parameters" in text and "to see them swing" in text
    assert found.blind == (2, 3)
    assert all(np.isfinite(e.value) for e in found.parameters)


# -- servos -----------------------------------------------------------------------------------------------------------


def servo_log(seconds: float, seed: int, *, heat: float = 30.0) -> tuple[Arm, Log]:
    joint = Joint(
        name="joint_1",
        link="pendulum",
        kind="revolute",
        T_parent_joint=np.eye(4),
        axis=np.array([0.0, 1.0, 0.0]),
        mass=0.5,
        com=np.array([0.0, 0.0, -0.1]),
        inertia=1e-6 * np.eye(3),
    )
    arm = Arm(name="pendulum", joints=(joint,))
    t, q, dq, ddq = motion(1, seconds, seed)
    drive = arm.inverse_dynamics(q, dq, ddq)[:, 0] + 0.002 * ddq[:, 0] + 0.04 * np.tanh(dq[:, 0] / 1e-3)
    drive += 0.01 * dq[:, 0]
    power = heat * drive**2 + dq[:, 0] * drive
    bus = np.sign(drive) * np.maximum(power, 0.0) / 7.4
    time_ns = np.rint(t * 1e9).astype(np.int64)
    return arm, Log(
        time_ns=time_ns,
        position=q,
        effort=bus[:, None],
        joint_names=("joint_1",),
        signals={"voltage": Signal(time_ns, np.full(len(t), 7.4), "V")},
        meta={"effort_unit": "A"},
    )


def test_servo_with_the_current_of_its_supply():
    arm, log = servo_log(20.0, 0)
    drive = fit_bus_drive(arm, [log, servo_log(20.0, 1)[1]])
    assert drive.heat == pytest.approx(30.0, rel=0.05)
    assert drive.coulomb == pytest.approx(0.04, rel=0.15)
    torque, data = drive.load_torque(servo_log(20.0, 2)[1])
    heavy = data.reduce(lambda s: arm.inverse_dynamics(s.q, s.dq, s.ddq))[:, 0]
    assert heavy @ torque / (heavy @ heavy) == pytest.approx(1.0, abs=0.03)
    bus = np.array([0.3, -0.3, 0.0])
    tau = drive.motor_torque(bus, np.full(3, 7.4), np.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(drive.heat * tau**2 + tau, np.abs(bus) * 7.4, atol=1e-12)
    with pytest.raises(InputError, match="voltage"):
        fit_bus_drive(arm, dataclasses.replace(log, signals={}))
    with pytest.raises(InputError, match="one joint"):
        fit_bus_drive(truth(), log)
    off = Signal(log.time_ns, np.zeros(len(log)), "1")
    with pytest.raises(LogError, match="off"):
        fit_bus_drive(arm, dataclasses.replace(log, signals={**log.signals, "enabled": off}))


def test_a_servo_that_is_held_by_its_friction_is_not_weighed():
    arm, log = servo_log(20.0, 0)
    drive = fit_bus_drive(arm, log)
    step = 2.0 * np.pi / 4096
    count = len(log) // 2
    rng = np.random.default_rng(0)
    # it stops, its encoder flickers, and the drive gives half as much again as the load asks for
    q = np.concatenate([log.position[:count], log.position[count] + step * rng.integers(0, 2, (count, 1))])
    bus = log.effort[: 2 * count].copy()
    still = arm.gravity_torque(log.position[count])[0]
    bus[count:, 0] = np.sign(still) * 30.0 * (1.5 * still) ** 2 / 7.4
    counted = dataclasses.replace(
        log[: 2 * count], position=step * np.round(q / step), effort=bus, velocity=None
    )
    assert prepare(counted).resolution[0] == pytest.approx(step, rel=1e-6)
    assert drive.weigh(arm, counted) == pytest.approx(0.5, rel=0.05)
    with pytest.raises(LogError, match="does not move"):
        drive.weigh(arm, counted[count + 100 :])
    with pytest.raises(InputError, match="one joint"):
        drive.weigh(truth(), log)


# -- the encoders' noise ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("noise", [5e-5, 1e-3])
def test_the_encoders_noise_is_found(step: float, noise: float) -> None:
    """In motion, rounded or not: within a tenth in every joint, or not seen below the rounding."""
    arm = truth()
    rng = np.random.default_rng(7)
    found = []
    for seed in range(4):
        log = simulate(arm, 10.0, seed=seed)
        position = log.position + noise * rng.standard_normal(log.position.shape)
        if step:
            position = step * np.rint(position / step)
        log = dataclasses.replace(log, position=position, velocity=None)
        data = prepare(log)
        assert data.velocity_noise is None
        found.append(
            [beside_rounding(s, r) for s, r in zip(data.position_noise, data.resolution, strict=True)]
        )
    if noise > step:
        np.testing.assert_allclose(found, noise, rtol=0.1)
    elif step:
        # rounding hides smaller noise: what is told stays below it
        assert np.max(found) < noise + step / math.sqrt(12.0)


def test_an_so101_weighs_with_its_identified_card() -> None:
    """Its filter would believe each reading of the encoders, were their noise not in the card."""
    place = W.scene(W.load_arm("so101"))
    arm = place.arm

    def trial(poses: list[np.ndarray], mass: float, duration: float, **timing: float) -> Log:
        task = W.Task(
            scene=place,
            start=poses[0],
            poses=tuple(poses[1:]),
            loads=((0.0, mass),),
            duration=duration,
            seed=3,
            **timing,
        )
        return W.run(task, W.make_pipeline(arm)[0]).log

    rng = np.random.default_rng(0)
    lower = np.array([max(j.limits.lower, -1.5) for j in arm.joints])
    upper = np.array([min(j.limits.upper, 1.5) for j in arm.joints])
    start = place.poses[place.start]
    free = trial(
        [start, *(lower + (upper - lower) * rng.random(arm.n) for _ in range(16))],
        0.0,
        25.0,
        move=1.2,
        hold=0.3,
    )
    undescribed = arm.replace(joints=tuple(j.replace(sensing=Sensing()) for j in arm.joints))
    card = fit(undescribed, free).arm
    for joint, true in zip(card.joints, arm.joints, strict=True):
        assert joint.sensing.position_std == pytest.approx(true.sensing.position_std, rel=0.1)
        assert joint.sensing.position_resolution == pytest.approx(true.sensing.position_resolution, rel=1e-3)
    log = trial([start, place.poses[place.pose]], 0.25, 6.0, move=3.0)
    found = W.weigh_log(log, card)
    assert found.status == Status.ok
    assert abs(found.mass - 0.25) < min(5.0 * found.mass_std, 0.05 * 0.25)
