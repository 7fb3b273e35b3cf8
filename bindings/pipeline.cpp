// Observers, payload estimators and the pipeline that joins them.
#include "common.hpp"
#include "objects.hpp"
#include "rows.hpp"

#include "palpate/observers/published_kalman.hpp"
#include "palpate/tare.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

ObserverConfig observer_config(const nb::object& o) {
  if (o.is_none()) return std::monostate{};
  if (nb::isinstance<InverseDynamicsConfig>(o)) return nb::cast<InverseDynamicsConfig>(o);
  if (nb::isinstance<ModelResidualConfig>(o)) return nb::cast<ModelResidualConfig>(o);
  if (nb::isinstance<SlidingModeConfig>(o)) return nb::cast<SlidingModeConfig>(o);
  if (nb::isinstance<MomentumConfig>(o)) return nb::cast<MomentumConfig>(o);
  if (nb::isinstance<SuperTwistingConfig>(o)) return nb::cast<SuperTwistingConfig>(o);
  if (nb::isinstance<DisturbanceKalmanConfig>(o)) return nb::cast<DisturbanceKalmanConfig>(o);
  if (nb::isinstance<ExtendedKalmanConfig>(o)) return nb::cast<ExtendedKalmanConfig>(o);
  throw nb::value_error("observer: expected None, InverseDynamicsObserver, ModelResidualObserver, SlidingModeObserver, MomentumObserver, "
                        "MomentumSuperTwisting, DisturbanceKalman or ExtendedKalman");
}
PayloadConfig payload_config(const nb::object& o) {
  if (o.is_none()) return std::monostate{};
  if (nb::isinstance<JointFormulaConfig>(o)) return nb::cast<JointFormulaConfig>(o);
  if (nb::isinstance<RegressionConfig>(o)) return nb::cast<RegressionConfig>(o);
  if (nb::isinstance<PayloadFilterConfig>(o)) return nb::cast<PayloadFilterConfig>(o);
  throw nb::value_error("payload: expected None, JointFormula, Regression or PayloadFilter");
}

template <class C>
std::optional<C> optional_config(const nb::object& o, const char* what, const char* expected) {
  if (o.is_none()) return std::nullopt;
  if (nb::isinstance<C>(o)) return nb::cast<C>(o);
  throw nb::value_error((std::string(what) + ": expected None or " + expected).c_str());
}

void fill(RawSample& raw, int n, const double* position, const double* velocity, const double* effort, const double* model) {
  const auto un = static_cast<std::size_t>(n);
  raw.has_velocity = velocity != nullptr;
  raw.has_model_torque = model != nullptr;
  for (std::size_t j = 0; j < un; ++j) {
    raw.position[j] = position[j];
    raw.effort[j] = effort[j];
    if (velocity != nullptr) raw.velocity[j] = velocity[j];
    if (model != nullptr) raw.model_torque[j] = model[j];
  }
}

using OptionalVector = std::optional<Vector>;
using OptionalRows = std::optional<Rows>;

const double* checked(const Vector& v, int n, const char* name) {
  expect(v.shape(0) == static_cast<std::size_t>(n), std::string(name) + ": expected " + std::to_string(n) + " numbers, got " + std::to_string(v.shape(0)));
  return v.data();
}
const double* checked(const Rows& r, std::size_t N, int n, const char* name) {
  expect(r.shape(0) == N && r.shape(1) == static_cast<std::size_t>(n),
         std::string(name) + ": expected shape (" + std::to_string(N) + ", " + std::to_string(n) + "), got (" + std::to_string(r.shape(0)) + ", " + std::to_string(r.shape(1)) + ")");
  return r.data();
}

template <class T, std::size_t N>
nb::object numbers(const std::array<T, N>& a, std::vector<std::size_t> shape = {N}) {
  Output<T> out(std::move(shape));
  std::copy(a.begin(), a.end(), out.data);
  return out.array;
}

nb::dict run(PyPipeline& p, const Times& time, const Rows& position, const OptionalRows& velocity, const Rows& effort, const OptionalRows& model) {
  const std::size_t N = time.shape(0);
  const int n = p.n;
  const auto un = static_cast<std::size_t>(n);
  const double* q = checked(position, N, n, "position");
  const double* e = checked(effort, N, n, "effort");
  const double* v = velocity ? checked(*velocity, N, n, "velocity") : nullptr;
  const double* m = model ? checked(*model, N, n, "model_torque") : nullptr;
  TouchRows rows(N, un, p.pipeline.config());
  unlocked([&] {
    RawSample raw;
    for (std::size_t i = 0; i < N; ++i) {
      raw.time_ns = time.data()[i];
      fill(raw, n, q + i * un, v ? v + i * un : nullptr, e + i * un, m ? m + i * un : nullptr);
      rows.fill(i, p.pipeline.step(raw));
    }
  });
  return rows.dict();
}

}  // namespace

PyPipeline::PyPipeline(std::shared_ptr<const Arm> arm, const nb::object& observer, const nb::object& payload, const ConditionerConfig& conditioner,
                       const LoadConfig& load, const nb::object& wrench, const nb::object& contact)
    : pipeline(arm, {conditioner, observer_config(observer), payload_config(payload), load,
                     optional_config<WrenchConfig>(wrench, "wrench", "WrenchEstimator"),
                     optional_config<ContactConfig>(contact, "contact", "ContactDetector")}),
      n(arm->n()) {}

void bind_pipeline(nb::module_& m) {
  bind_config<InverseDynamicsConfig>(m, "InverseDynamicsObserver", "tau_ext = M q'' + C q' + g + tau_f - tau, low-passed (MATH.md section 3). The baseline.",
                                     {{"cutoff", &InverseDynamicsConfig::cutoff, "of the low-pass [rad/s]"},
                                      {"friction_fraction", &InverseDynamicsConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"}});
  bind_config<ModelResidualConfig>(m, "ModelResidualObserver", "tau_ext = the controller's own bare-arm torque - tau. Needs no masses.",
                                   {{"cutoff", &ModelResidualConfig::cutoff, "of the low-pass [rad/s]"},
                                    {"friction_fraction", &ModelResidualConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"}});
  bind_config<SlidingModeConfig>(m, "SlidingModeObserver", "Second-order sliding-mode observer (R eqs. 4-7; Davila, Fridman, Levant 2005).",
                                 {{"lambda_", &SlidingModeConfig::lambda, "[rad^1/2/s]"},
                                  {"alpha", &SlidingModeConfig::alpha, "[rad/s^2]; must exceed sup |M^-1 tau_ext|, else status saturated"},
                                  {"gamma", &SlidingModeConfig::gamma, "width of the smooth sign tanh(e / 2 gamma) [rad]; 0: the true sign"},
                                  {"friction", &SlidingModeConfig::friction, "friction in the observer's model; the published curves had none"},
                                  {"order", &SlidingModeConfig::order, "of the Butterworth low-pass"},
                                  {"cutoff", &SlidingModeConfig::cutoff, "of the low-pass [rad/s]"},
                                  {"solver", &SlidingModeConfig::solver, "'euler', 'rk4' or 'dormand_prince'"},
                                  {"substeps", &SlidingModeConfig::substeps, "solver steps per sample; 0: as many as needed"},
                                  {"friction_fraction", &SlidingModeConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"}});
  bind_config<MomentumConfig>(m, "MomentumObserver", "Momentum observer (De Luca, Mattone 2003): r' = K (tau_ext - r), no acceleration needed.",
                              {{"bandwidth", &MomentumConfig::bandwidth, "K [rad/s]"},
                               {"friction_fraction", &MomentumConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"}});
  bind_config<SuperTwistingConfig>(m, "MomentumSuperTwisting", "Momentum observer with super-twisting injection (Garofalo et al. 2019).",
                                   {{"max_rate", &SuperTwistingConfig::max_rate, "fastest change of tau_ext to follow [N m/s]"},
                                    {"gain", &SuperTwistingConfig::gain, "lambda = gain sqrt(max_rate) [1]"},
                                    {"friction_fraction", &SuperTwistingConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"}});
  bind_config<DisturbanceKalmanConfig>(m, "DisturbanceKalman", "Kalman filter on the momentum with tau_ext as its disturbance (Wahrburg et al. 2015); full covariance.",
                                       {{"disturbance_rate", &DisturbanceKalmanConfig::disturbance_rate, "growth of tau_ext's standard deviation [N m/sqrt(s)]"},
                                        {"decay", &DisturbanceKalmanConfig::decay, "tau_ext forgets itself at this rate [1/s]"},
                                        {"disturbance_prior_std", &DisturbanceKalmanConfig::disturbance_prior_std, "of tau_ext at the start [N m]"},
                                        {"model_torque_std", &DisturbanceKalmanConfig::model_torque_std, "model error, white per sample [N m]"},
                                        {"friction_fraction", &DisturbanceKalmanConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"},
                                        {"friction_time", &DisturbanceKalmanConfig::friction_time, "how long such an error lasts [s]"}});
  bind_config<ExtendedKalmanConfig>(m, "ExtendedKalman", "Extended Kalman filter on (q, q') with tau_ext as states (R eqs. 9-14, corrected).",
                                    {{"disturbance", &ExtendedKalmanConfig::disturbance, "estimate tau_ext too"},
                                     {"disturbance_rate", &ExtendedKalmanConfig::disturbance_rate, "growth of tau_ext's standard deviation [N m/sqrt(s)]"},
                                     {"disturbance_prior_std", &ExtendedKalmanConfig::disturbance_prior_std, "of tau_ext at the start [N m]"},
                                     {"velocity_prior_std", &ExtendedKalmanConfig::velocity_prior_std, "of q' at the start [rad/s]"},
                                     {"model_torque_std", &ExtendedKalmanConfig::model_torque_std, "model error, white per sample [N m]"},
                                     {"friction_fraction", &ExtendedKalmanConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"},
                                     {"max_step", &ExtendedKalmanConfig::max_step, "longer intervals are split [s]"}});
  bind_config<JointFormulaConfig>(m, "JointFormula", "m = tau_ext,i / (J_c,i^T g) at rest (R eq. 8, for any joint and mount).",
                                  {{"joint", &JointFormulaConfig::joint, "counted from 0; -1: the one nearest to the tip that feels the load"},
                                   {"lever", &JointFormulaConfig::lever, "axis to load [m]; nan: to the grasp point"},
                                   {"gravity", &JointFormulaConfig::gravity, "[m/s^2]; nan: the arm's"},
                                   {"sin_threshold", &JointFormulaConfig::sin_threshold, "smallest |sin theta| [1]"},
                                   {"speed_threshold", &JointFormulaConfig::speed_threshold, "largest ||q'|| [rad/s]"},
                                   {"ok_relative", &JointFormulaConfig::ok_relative, "status ok below this part of the mass [1]"},
                                   {"ok_absolute", &JointFormulaConfig::ok_absolute, "or below this [kg]"}});
  bind_config<RegressionConfig>(m, "Regression", "Recursive least squares of the load on tau_ext of all joints, with friction biases (MATH.md section 4).",
                                {{"first_moment", &RegressionConfig::first_moment, "estimate m and m (c - grasp)"},
                                 {"mass_prior_std", &RegressionConfig::mass_prior_std, "[kg]"},
                                 {"offset_prior_std", &RegressionConfig::offset_prior_std, "of the grasp point [m]"},
                                 {"lag", &RegressionConfig::lag, "lag of the observer before it, NaN: as that observer knows it [s]"},
                                 {"acceleration_time", &RegressionConfig::acceleration_time, "time constant of the acceleration [s]"},
                                 {"friction_fraction", &RegressionConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"},
                                 {"bias_time", &RegressionConfig::bias_time, "how long an error of friction or gain lasts [s]"},
                                 {"settling_time", &RegressionConfig::settling_time, "a joint that starts, stops or reverses is not used so long [s]"},
                                 {"ok_relative", &RegressionConfig::ok_relative, "status ok below this part of the mass [1]"},
                                 {"ok_absolute", &RegressionConfig::ok_absolute, "or below this [kg]"}});
  bind_config<PayloadFilterConfig>(m, "PayloadFilter", "Payload Kalman filter: state (q, q', m[, m delta]); at rest and in motion (MATH.md section 4).",
                                   {{"first_moment", &PayloadFilterConfig::first_moment, "estimate m and m (c - grasp)"},
                                    {"mass_prior_std", &PayloadFilterConfig::mass_prior_std, "[kg]"},
                                    {"offset_prior_std", &PayloadFilterConfig::offset_prior_std, "of the grasp point [m]"},
                                    {"velocity_prior_std", &PayloadFilterConfig::velocity_prior_std, "of q' at the start [rad/s]"},
                                    {"model_torque_std", &PayloadFilterConfig::model_torque_std, "model error, white per sample [N m]"},
                                    {"friction_fraction", &PayloadFilterConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"},
                                    {"friction_time", &PayloadFilterConfig::friction_time, "how long such an error lasts [s]"},
                                    {"change_threshold", &PayloadFilterConfig::change_threshold, "a load change is declared at so many standard deviations [1]"},
                                    {"min_change", &PayloadFilterConfig::min_change, "smaller changes are not declared [kg]"},
                                    {"max_step", &PayloadFilterConfig::max_step, "longer intervals are split [s]"},
                                    {"ok_relative", &PayloadFilterConfig::ok_relative, "status ok below this part of the mass [1]"},
                                    {"ok_absolute", &PayloadFilterConfig::ok_absolute, "or below this [kg]"}});
  bind_config<LoadConfig>(m, "HeldLoad", "What is held and known, taken away before wrench and contact are judged.",
                          {{"mass", &LoadConfig::mass, "[kg]; nan: what the payload estimator says, once it is ok"},
                           {"com", &LoadConfig::com, "centre of mass from the grasp point, tip axes [m]; with a given mass"},
                           {"mass_std", &LoadConfig::mass_std, "of a given mass [kg]"},
                           {"acceleration_time", &LoadConfig::acceleration_time, "time constant of the acceleration its inertia needs [s]"}});
  bind_config<WrenchConfig>(m, "WrenchEstimator", "Wrench at the hand: (J S^-1 J^T + prior^-1)^-1 J S^-1 tau_ext, with covariance (MATH.md section 5).",
                            {{"axes", &WrenchConfig::axes, "of force and moment: 'base' or 'tip'"},
                             {"point", &WrenchConfig::point, "about which the moment is: 'grasp' or 'tip'"},
                             {"force_prior_std", &WrenchConfig::force_prior_std, "how large a force may be, each direction [N]"},
                             {"moment_prior_std", &WrenchConfig::moment_prior_std, "and a moment [N m]; 0: a force alone acts at the point"},
                             {"singular_share", &WrenchConfig::singular_share, "a component is singular above this part of the prior's variance [1]"}});
  bind_config<ContactConfig>(m, "ContactDetector", "Two-sided CUSUM per joint on whitened innovations, with a stated false-alarm rate (MATH.md section 5).",
                             {{"false_alarms_per_hour", &ContactConfig::false_alarms_per_hour, "of the whole arm, while its errors are as stated [1/h]"},
                              {"source", &ContactConfig::source, "'momentum', or 'model_residual': the controller's own model"},
                              {"noise_std", &ContactConfig::noise_std, "per joint: white error of the torque per sample, beside the arm's own [N m]"},
                              {"model_std", &ContactConfig::model_std, "per joint: slow error of the model in motion, beside the friction's [N m]"},
                              {"model_time", &ContactConfig::model_time, "how long such an error lasts in motion [s]"},
                              {"friction_fraction", &ContactConfig::friction_fraction, "friction model's error in motion, part of Coulomb friction [1]"},
                              {"rest_time", &ContactConfig::rest_time, "how fast friction wanders within +-F at rest [s]"},
                              {"settle_time", &ContactConfig::settle_time, "how long friction takes to settle after rest or a reversal [s]"},
                              {"clip", &ContactConfig::clip, "a sample counts for no more [std]"},
                              {"contact_time", &ContactConfig::contact_time, "time constant of the contact torque reported [s]"},
                              {"release_time", &ContactConfig::release_time, "nothing felt for so long ends a contact [s]"},
                              {"warm_up", &ContactConfig::warm_up, "no test for so long after a start or a gap [s]"}});
  bind_config<PublishedKalmanConfig>(m, "PublishedKalman", "The filter that made the published curves, errors included. For reproduction only.",
                                     {{"Q", &PublishedKalmanConfig::Q, "process noise times the identity"},
                                      {"R", &PublishedKalmanConfig::R, "measurement noise times the identity"},
                                      {"P0", &PublishedKalmanConfig::P0, "initial covariance times the identity"},
                                      {"delta_t", &PublishedKalmanConfig::delta_t, "enters F [s]"}});

  nb::class_<ConditionerConfig>(m, "Conditioner", "How raw samples become fit for estimation.")
      .def("__init__", [](ConditionerConfig* self, bool differentiate, int points, double time_constant, double max_gap) {
        ConditionerConfig c;
        c.velocity = differentiate ? VelocitySource::differentiate : VelocitySource::driver;
        c.differentiator.points = points;
        c.differentiator.time_constant = time_constant;
        c.max_gap = max_gap;
        new (self) ConditionerConfig(c);
      }, nb::kw_only(), nb::arg("differentiate") = false, nb::arg("points") = 2, nb::arg("time_constant") = 0.0, nb::arg("max_gap") = 0.1,
           "differentiate: ignore the driver's velocity; points: samples in the slope, 2 to 16; time_constant [s] of a low-pass behind it; max_gap [s].")
      .def("options", [](const ConditionerConfig& c) {
        nb::dict d;
        d["differentiate"] = c.velocity == VelocitySource::differentiate;
        d["points"] = c.differentiator.points;
        d["time_constant"] = c.differentiator.time_constant;
        d["max_gap"] = c.max_gap;
        return d;
      });

  nb::class_<PyTouch>(m, "Touch", "Everything known after one sample.")
      .def_prop_ro("time_ns", [](const PyTouch& t) { return t.touch.time_ns; })
      .def_prop_ro("status", [](const PyTouch& t) { return t.touch.status; }, "of the sample")
      .def_prop_ro("q", [](const PyTouch& t) { return array(t.touch.q, t.n); }, "estimated position [rad]")
      .def_prop_ro("dq", [](const PyTouch& t) { return array(t.touch.dq, t.n); }, "estimated velocity [rad/s]")
      .def_prop_ro("external_torque", [](const PyTouch& t) { return array(t.touch.external.torque, t.n); }, "[N m], > 0 when the environment pushes the joint forward")
      .def_prop_ro("external_torque_std", [](const PyTouch& t) { return array(t.touch.external.std, t.n); }, "[N m]")
      .def_prop_ro("external_status", [](const PyTouch& t) { return t.touch.external.status; })
      .def_prop_ro("mass", [](const PyTouch& t) { return t.touch.payload.mass; }, "[kg]")
      .def_prop_ro("mass_std", [](const PyTouch& t) { return t.touch.payload.mass_std; }, "[kg]")
      .def_prop_ro("first_moment", [](const PyTouch& t) { return nb::make_tuple(t.touch.payload.first_moment[0], t.touch.payload.first_moment[1], t.touch.payload.first_moment[2]); }, "m (c - grasp) [kg m], tip axes")
      .def_prop_ro("changes", [](const PyTouch& t) { return t.touch.payload.changes; }, "grasps and releases seen")
      .def_prop_ro("change_time_ns", [](const PyTouch& t) { return t.touch.payload.change_time_ns; })
      .def_prop_ro("payload_status", [](const PyTouch& t) { return t.touch.payload.status; })
      .def_prop_ro("wrench", [](const PyTouch& t) {
        const Wrench& w = t.touch.wrench;
        nb::dict d;
        d["force"] = numbers(w.force);
        d["force_std"] = numbers(w.force_std);
        d["moment"] = numbers(w.moment);
        d["moment_std"] = numbers(w.moment_std);
        d["covariance"] = numbers(w.covariance, {6, 6});
        d["singular"] = numbers(w.singular);
        d["conditioning"] = w.conditioning;
        d["load_mass"] = w.load_mass;
        d["status"] = w.status;
        return d;
      }, "as in run()'s rows")
      .def_prop_ro("contact", [](const PyTouch& t) {
        const Contact& c = t.touch.contact;
        nb::dict d;
        d["active"] = c.active;
        d["link"] = c.link;
        d["farthest"] = c.farthest;
        d["tip"] = c.tip;
        d["torque"] = array(c.torque, t.n);
        d["std"] = array(c.std, t.n);
        d["level"] = array(c.level, t.n);
        d["count"] = c.count;
        d["onset_time_ns"] = c.onset_time_ns;
        d["alarm_time_ns"] = c.alarm_time_ns;
        d["release_time_ns"] = c.release_time_ns;
        d["status"] = c.status;
        return d;
      }, "as in run()'s rows");

  nb::class_<PyPipeline>(m, "Pipeline", "One path from samples to Touch; see palpate.Pipeline.")
      .def(nb::init<std::shared_ptr<const Arm>, const nb::object&, const nb::object&, const ConditionerConfig&, const LoadConfig&, const nb::object&, const nb::object&>(), nb::arg("arm"),
           nb::arg("observer").none(), nb::arg("payload").none(), nb::arg("conditioner"), nb::arg("load") = LoadConfig{}, nb::arg("wrench") = nb::none(), nb::arg("contact") = nb::none())
      .def("step", [](PyPipeline& p, std::int64_t time_ns, const Vector& position, const OptionalVector& velocity, const Vector& effort, const OptionalVector& model) {
        RawSample raw;
        raw.time_ns = time_ns;
        fill(raw, p.n, checked(position, p.n, "position"), velocity ? checked(*velocity, p.n, "velocity") : nullptr, checked(effort, p.n, "effort"),
             model ? checked(*model, p.n, "model_torque") : nullptr);
        return PyTouch{p.pipeline.step(raw), p.n};
      }, nb::arg("time_ns"), nb::arg("position"), nb::arg("velocity").none(), nb::arg("effort"), nb::arg("model_torque") = nb::none())
      .def("run", &run, nb::arg("time_ns"), nb::arg("position"), nb::arg("velocity").none(), nb::arg("effort"), nb::arg("model_torque") = nb::none())
      .def("load", [](const PyPipeline& p) { return p.pipeline.load(); })
      .def("reset", [](PyPipeline& p) { p.pipeline.reset(); });

  m.def("solve_wrench", [](std::shared_ptr<const Arm> arm, const WrenchConfig& config, const Rows& position, const Rows& torque, const Stack& covariance) {
    const std::size_t N = position.shape(0);
    const int n = arm->n();
    const auto un = static_cast<std::size_t>(n);
    const double *q = checked(position, N, n, "position"), *tau = checked(torque, N, n, "torque");
    expect(covariance.shape(0) == N && covariance.shape(1) == un && covariance.shape(2) == un, "covariance: expected shape (N, n, n)");
    WrenchEstimator estimator(*arm, config);
    const LoadTorque nothing_held(*arm);
    WrenchRows out(N);
    unlocked([&] {
      for (std::size_t i = 0; i < N; ++i) {
        ExternalTorque external;
        external.torque = row(tau, i, n);
        external.status = Status::ok;
        JointMatrix sigma{};
        for (int r = 0; r < n; ++r)
          for (int c = 0; c < n; ++c) sigma(r, c) = covariance.data()[(i * un + static_cast<std::size_t>(r)) * un + static_cast<std::size_t>(c)];
        out.fill(i, estimator.step(row(q, i, n), external, sigma, nothing_held));
      }
    });
    return out.dict();
  }, nb::arg("arm"), nb::arg("config"), nb::arg("position"), nb::arg("torque"), nb::arg("covariance"),
        "Wrenches (one per row) of external torques (N, n) [N m] with their covariance (N, n, n) [N^2 m^2]; nothing is held.");

  m.def("tare", [](std::shared_ptr<const Arm> arm, double mass_std, const Times& time, const Rows& position, const OptionalRows& velocity, const Rows& effort) {
    const std::size_t N = time.shape(0);
    const int n = arm->n();
    const auto un = static_cast<std::size_t>(n);
    const double* q = checked(position, N, n, "position");
    const double* e = checked(effort, N, n, "effort");
    const double* v = velocity ? checked(*velocity, N, n, "velocity") : nullptr;
    JointVector gain{};
    for (int j = 0; j < n; ++j) gain[static_cast<std::size_t>(j)] = arm->joint(j).effort_gain;
    TareConfig config;
    config.mass_std = mass_std;
    Conditioner conditioner(n, gain);
    Tare tare(*arm, config);
    std::size_t used = 0;
    unlocked([&] {
      RawSample raw;
      for (std::size_t i = 0; i < N; ++i) {
        raw.time_ns = time.data()[i];
        fill(raw, n, q + i * un, v ? v + i * un : nullptr, e + i * un, nullptr);
        used += tare.step(conditioner.step(raw)) == Status::ok ? 1u : 0u;
      }
    });
    return nb::make_tuple(array(tare.factors(), n), array(tare.factor_std(), n), used);
  }, nb::arg("arm"), nb::arg("mass_std"), nb::arg("time_ns"), nb::arg("position"), nb::arg("velocity").none(), nb::arg("effort"),
        "Mass factor of every link, its standard deviation, and the number of samples used.");

  struct PublishedFilter {
    std::shared_ptr<const Arm> arm;
    PublishedKalman filter;
  };
  nb::class_<PublishedFilter>(m, "PublishedKalmanFilter", "Runs PublishedKalman sample by sample.")
      .def("__init__", [](PublishedFilter* self, std::shared_ptr<const Arm> arm, const PublishedKalmanConfig& config) {
        new (self) PublishedFilter{arm, PublishedKalman(*arm, config)};
      }, nb::arg("arm"), nb::arg("config"))
      .def("step", [](PublishedFilter& self, double dt, const Vector& q, const Vector& tau) {
        JointSample s;
        s.dt = dt;
        s.q = joints(q, self.arm->n(), "q");
        s.tau = joints(tau, self.arm->n(), "tau");
        s.status = Status::ok;
        self.filter.step(s);
        return nb::make_tuple(array(self.filter.positions(), self.arm->n()), array(self.filter.velocities(), self.arm->n()));
      }, nb::arg("dt"), nb::arg("q"), nb::arg("tau"), "dt [s]; q measured [rad]; tau held over dt [N m]. Returns (q, dq) estimated.");
}

}  // namespace palpate_py
