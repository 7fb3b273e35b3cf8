// Time per call of palpate's estimators on one core, with the same computation on Pinocchio and Eigen in the same run.
//
//   benchmark_speed [--calls N] [--arm NAME] [--json]
//
// Every single call is timed (latency: nothing overlaps with it), the clock's own time is subtracted. Samples come from a
// moving arm that holds a load half of the time, so no two calls are alike. Contestants take turns in blocks of 1024 calls.
// Columns in microseconds: the median, 99 % and 99.9 % quantiles and the largest of all calls, disturbances by other work
// on the machine included; `quiet` is the median of that sixteenth of the calls where it was least, and ratios are taken from
// it. (A mean of few calls is worse: on a busy machine every millisecond's worth of calls holds an interruption.)
// Before timing, all contestants take the same 4096 samples in step and must find the same numbers. Some filters are so
// sensitive that rounding alone decides later digits (a load's first moment on a light arm): palpate
// therefore takes the samples a second time with every position changed in its last digit, and what that changes is told too.
#include <pthread.h>
#include <sched.h>
#include <sys/resource.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <limits>
#include <string>

#include "arms.hpp"  // written by the build from palpate.robots
#include "contest.hpp"
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/sliding_mode.hpp"
#include "palpate/payload_filter.hpp"

#ifdef PALPATE_HAS_PINOCCHIO
contest::Entries pinocchio_entries(const palpate::ArmDescription& arm, contest::Job job);  // rival.cpp
#endif

namespace {

using namespace palpate;
using contest::Job;
using contest::Numbers;

constexpr int period = 4096;    // samples until the motion repeats
constexpr int block = 1024;     // calls in a turn
constexpr int rounds = 16;
constexpr double dt = 1e-3;     // [s]

std::size_t u(int i) { return static_cast<std::size_t>(i); }

// --- palpate -----------------------------------------------------------------------------------------------------

struct InverseDynamics {
  explicit InverseDynamics(const ArmDescription& d) : arm(d) {}
  void step(const JointSample& s) { tau = inverse_dynamics<double>(arm, s.q, s.dq, s.tau); }  // any numbers will do for q''
  Numbers numbers() const {
    Numbers out;
    out.add(tau, arm.n());
    return out;
  }
  Arm arm;
  JointVector tau{};
};

struct MassMatrix {
  explicit MassMatrix(const ArmDescription& d) : arm(d) {}
  void step(const JointSample& s) { M = mass_matrix<double>(arm, s.q); }
  Numbers numbers() const {
    Numbers out;
    for (int i = 0; i < arm.n(); ++i)
      for (int j = i; j < arm.n(); ++j) out.add(M(i, j));
    return out;
  }
  Arm arm;
  JointMatrix M{};
};

struct ForwardDynamics {
  explicit ForwardDynamics(const ArmDescription& d) : arm(d) {}
  void step(const JointSample& s) { ddq = forward_dynamics<double>(arm, s.q, s.dq, s.tau); }
  Numbers numbers() const {
    Numbers out;
    out.add(ddq, arm.n());
    return out;
  }
  Arm arm;
  JointVector ddq{};
};

std::unique_ptr<contest::Entry> ours(const ArmDescription& arm, Job job) {
  using contest::Observing, contest::Timed, contest::Weighing;
  constexpr const char* how = "palpate";
  switch (job) {
    case Job::momentum: return std::make_unique<Timed<Observing<MomentumObserver>>>(how, arm, MomentumConfig{});
    case Job::sliding_mode: return std::make_unique<Timed<Observing<SlidingModeObserver>>>(how, arm, SlidingModeConfig{});
    case Job::sliding_mode_twice: return std::make_unique<Timed<Observing<SlidingModeObserver>>>(how, arm, SlidingModeConfig{.substeps = 2});
    case Job::kalman: return std::make_unique<Timed<Observing<ExtendedKalman>>>(how, arm, contest::smoother<ExtendedKalmanConfig>());
    case Job::kalman_disturbance: return std::make_unique<Timed<Observing<ExtendedKalman>>>(how, arm, ExtendedKalmanConfig{});
    case Job::payload_mass: return std::make_unique<Timed<Weighing<PayloadFilter>>>(how, arm, contest::weigher<PayloadFilterConfig>(false));
    case Job::payload_moment: return std::make_unique<Timed<Weighing<PayloadFilter>>>(how, arm, contest::weigher<PayloadFilterConfig>(true));
    case Job::inverse_dynamics: return std::make_unique<Timed<InverseDynamics>>(how, arm);
    case Job::mass_matrix: return std::make_unique<Timed<MassMatrix>>(how, arm);
    case Job::forward_dynamics: return std::make_unique<Timed<ForwardDynamics>>(how, arm);
  }
  return nullptr;
}

// --- what is asked -----------------------------------------------------------------------------------------------

constexpr double none = std::numeric_limits<double>::quiet_NaN();

/// A job and what it should reach: reported, never asserted, because machines differ.
struct Task {
  Job job;
  const char* name;
  double p50 = none, p999 = none;  ///< at most [us]
  double ratio = none;             ///< at least so many times faster than the rival
};
constexpr Task tasks[] = {
    {Job::momentum, "momentum observer", 1.0, 3.0, 3.0},
    {Job::sliding_mode, "sliding-mode observer, default", 2.5},
    {Job::sliding_mode_twice, "sliding-mode observer, rk4 x2"},
    {Job::kalman, "extended Kalman filter", 8.0, none, 1.0},
    {Job::kalman_disturbance, "extended Kalman filter, with tau_ext", 8.0, none, 1.0},
    {Job::payload_mass, "payload filter, m", 15.0, none, 1.0},
    {Job::payload_moment, "payload filter, m and m c", 15.0, none, 1.0},
    {Job::inverse_dynamics, "inverse dynamics"},
    {Job::mass_matrix, "mass matrix"},
    {Job::forward_dynamics, "forward dynamics"},
};

struct Robot {
  std::string name;
  ArmDescription arm;
};

/// A light arm with coarse encoders as published, and an industrial one with what an identified arm has: dry friction, encoders
/// and torques of finite resolution. Every state of the payload filter is then in use. (The latter as its data sheet has it,
/// with sensors of no error, would make the filters compute with rounding only: their numbers then differ by up to 1e-5.)
std::vector<Robot> robots() {
  ArmDescription d = kuka_lbr_iiwa14;
  for (int j = 0; j < d.n; ++j) {
    d.joints[u(j)].friction.coulomb = 0.5;
    d.joints[u(j)].position_resolution = 1e-5;
    d.joints[u(j)].torque_resolution = 0.1;
  }
  return {{"justina_left_arm_box", justina_left_arm_box}, {"kuka_lbr_iiwa14 with dry friction and encoders", d}};
}

/// Normal numbers, the same on every machine (SplitMix64, sum of twelve uniform ones).
class Noise {
 public:
  double operator()() {
    double sum = -6.0;
    for (int i = 0; i < 12; ++i) sum += static_cast<double>(next() >> 11) * 0x1.0p-53;
    return sum;
  }

 private:
  std::uint64_t next() {
    std::uint64_t z = (x_ += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
  }
  std::uint64_t x_ = 0;
};

/// One period of a smooth motion, measured as the arm measures; it holds 0.25 kg in the second half.
std::vector<JointSample> measured_motion(const Arm& arm) {
  const auto rounded = [](double x, double step) { return step > 0.0 ? step * std::round(x / step) : x; };
  Noise noise;
  const Inertia<double> held = about_origin(0.25, arm.p_last_grasp(), Sym3<double>{});
  std::vector<JointSample> out(period);
  for (int k = 0; k < period; ++k) {
    JointSample& s = out[u(k)];
    JointVector q{}, dq{}, ddq{};
    for (int j = 0; j < arm.n(); ++j) {
      const double w = 2.0 * std::numbers::pi / (period * dt) * (1 + j % 2), phase = w * k * dt + j, size = 0.5;
      q[u(j)] = 0.3 + size * std::sin(phase);
      dq[u(j)] = size * w * std::cos(phase);
      ddq[u(j)] = -size * w * w * std::sin(phase);
    }
    const JointVector tau = inverse_dynamics<double>(arm, q, dq, ddq, k < period / 2 ? Inertia<double>{} : held);
    for (int j = 0; j < arm.n(); ++j) {
      const JointDescription& d = arm.joint(j);
      s.q[u(j)] = rounded(q[u(j)] + d.position_std * noise(), d.position_resolution);
      s.dq[u(j)] = dq[u(j)] + 0.01 * noise();
      s.dq_std[u(j)] = 0.01;
      s.tau[u(j)] = rounded(tau[u(j)] + d.friction.torque(dq[u(j)]) + d.torque_std * noise(), d.torque_resolution);
    }
    s.time_ns = static_cast<std::int64_t>(k) * 1'000'000;
    s.dt = dt;
    s.status = Status::ok;
  }
  return out;
}

// --- measuring ---------------------------------------------------------------------------------------------------

struct Clock {
  double ticks_per_us = 0.0;
  double overhead = 0.0;  // [ticks]
  double us(double ticks) const { return std::max(0.0, ticks - overhead) / ticks_per_us; }
};

double seconds() {
  std::timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

Clock calibrate() {
  Clock clock;
  const double start = seconds();
  const std::uint64_t first = contest::before();
  while (seconds() < start + 0.1) continue;
  const double ticks = static_cast<double>(contest::after() - first);
  clock.ticks_per_us = ticks / (1e6 * (seconds() - start));
  // Mean, not median: where the clock advances in coarse steps, one reading says little. Least of many, for quiet.
  double least = std::numeric_limits<double>::infinity();
  for (int turn = 0; turn < 200; ++turn) {
    double sum = 0.0;
    for (int k = 0; k < block; ++k) {
      const std::uint64_t t = contest::before();
      asm volatile("" : : : "memory");
      sum += static_cast<double>(contest::after() - t);
    }
    least = std::min(least, sum / block);
  }
  clock.overhead = least;
  return clock;
}

struct Result {
  double p50 = 0, p99 = 0, p999 = 0, worst = 0;  // [us] of all calls
  double best_p50 = 0;                           // of the round where it was least [us]
};

double quantile(std::vector<std::uint32_t>& ticks, double fraction) {
  const auto at = ticks.begin() + static_cast<std::ptrdiff_t>(fraction * static_cast<double>(ticks.size() - 1));
  std::nth_element(ticks.begin(), at, ticks.end());
  return *at;
}

struct Contestant {
  explicit Contestant(std::unique_ptr<contest::Entry> e) : entry(std::move(e)) {}
  std::unique_ptr<contest::Entry> entry;
  std::vector<std::uint32_t> all, round;  // ticks of every call, and of those in this round
  Result result;
};

std::vector<Contestant> contestants(const ArmDescription& arm, Job job) {
  std::vector<Contestant> out;
  out.emplace_back(ours(arm, job));
#ifdef PALPATE_HAS_PINOCCHIO
  for (auto& entry : pinocchio_entries(arm, job)) out.emplace_back(std::move(entry));
#endif
  return out;
}

/// Largest difference of a number from ours over one period, relative to the largest value it takes, or to a thousandth of the
/// largest value that any takes.
class Difference {
 public:
  void add(const Numbers& ours, const Numbers& other) {
    if (other.n != ours.n) difference_[0] = std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i < u(std::min(ours.n, other.n)); ++i) {
      const double d = std::abs(other.x[i] - ours.x[i]);
      difference_[i] = std::isnan(d) ? std::numeric_limits<double>::infinity() : std::max(difference_[i], d);
      largest_[i] = std::max(largest_[i], std::abs(ours.x[i]));
    }
  }
  double relative() const {
    const double floor = 1e-3 * *std::max_element(largest_.begin(), largest_.end());
    double worst = 0.0;
    for (std::size_t i = 0; i < largest_.size(); ++i)
      if (difference_[i] > 0.0) worst = std::max(worst, difference_[i] / std::max(largest_[i], floor));
    return worst;
  }

 private:
  std::array<double, Numbers{}.x.size()> difference_{}, largest_{};
};

struct Agreement {
  double difference = 0.0;   ///< of the contestants from ours
  double sensitivity = 0.0;  ///< of ours to the last digit of the positions
  /// Equal, as far as rounding lets them.
  bool holds() const { return difference < std::max(1e-9, 10.0 * sensitivity); }
};

Agreement agreement(std::vector<Contestant>& all, contest::Entry& twin, const std::vector<JointSample>& samples) {
  Difference contestants, digits;
  std::uint32_t ticks;
  double towards = 10.0;
  for (const JointSample& s : samples) {
    for (Contestant& c : all) c.entry->run(&s, 1, &ticks);
    JointSample changed = s;
    for (double& q : changed.q) q = std::nextafter(q, towards = -towards);
    twin.run(&changed, 1, &ticks);
    const Numbers ours = all.front().entry->numbers();
    for (const Contestant& c : all) contestants.add(ours, c.entry->numbers());
    digits.add(ours, twin.numbers());
  }
  return {contestants.relative(), digits.relative()};
}

void measure(std::vector<Contestant>& all, const std::vector<JointSample>& samples, int blocks_per_round, const Clock& clock) {
  std::uint32_t ticks[block];
  for (Contestant& c : all) {
    c.all.reserve(u(rounds) * u(blocks_per_round) * u(block));
    c.result.best_p50 = std::numeric_limits<double>::infinity();
  }
  int turn = 0;
  for (int round = 0; round < rounds; ++round) {
    for (Contestant& c : all) c.round.clear();
    for (int b = 0; b < blocks_per_round; ++b, ++turn) {
      const JointSample* first = samples.data() + (turn * block) % period;
      for (std::size_t i = 0; i < all.size(); ++i) {
        Contestant& c = all[(i + u(turn)) % all.size()];  // everyone follows everyone
        c.entry->run(first, block, ticks);
        c.round.insert(c.round.end(), ticks, ticks + block);
      }
    }
    for (Contestant& c : all) {
      c.all.insert(c.all.end(), c.round.begin(), c.round.end());
      c.result.best_p50 = std::min(c.result.best_p50, clock.us(quantile(c.round, 0.5)));
    }
  }
  for (Contestant& c : all) {
    c.result.p50 = clock.us(quantile(c.all, 0.5));
    c.result.p99 = clock.us(quantile(c.all, 0.99));
    c.result.p999 = clock.us(quantile(c.all, 0.999));
    c.result.worst = clock.us(quantile(c.all, 1.0));
  }
}

// --- telling -----------------------------------------------------------------------------------------------------

std::string number(double x) {
  if (!std::isfinite(x)) return "null";
  char text[32];
  std::snprintf(text, sizeof text, "%.6g", x);
  return text;
}

void print_json(const Task& task, const Agreement& agreed, const std::vector<Contestant>& all, bool first) {
  std::printf("%s\n      {\"what\": \"%s\", \"required\": {\"p50\": %s, \"p999\": %s, \"ratio\": %s}, \"disagreement\": %s, \"sensitivity\": %s, \"contestants\": [",
              first ? "" : ",", task.name, number(task.p50).c_str(), number(task.p999).c_str(), number(task.ratio).c_str(),
              number(agreed.difference).c_str(), number(agreed.sensitivity).c_str());
  for (const Contestant& c : all) {
    const Result& r = c.result;
    std::printf("%s\n        {\"how\": \"%s\", \"calls\": %zu, \"p50\": %s, \"p99\": %s, \"p999\": %s, "
                "\"worst\": %s, \"best_p50\": %s}",
                &c == &all.front() ? "" : ",", c.entry->how(), c.all.size(), number(r.p50).c_str(), number(r.p99).c_str(), number(r.p999).c_str(), number(r.worst).c_str(),
                number(r.best_p50).c_str());
  }
  std::printf("]}");
}

void print_table(const Task& task, const Agreement& agreed, const std::vector<Contestant>& all) {
  std::printf("%-66s%9s%9s%9s%10s%9s%8s\n", task.name, "p50", "p99", "p99.9", "worst", "quiet", "ratio");
  for (const Contestant& c : all) {
    const Result& r = c.result;
    const std::string who = std::string(&c == &all.front() ? "" : "Pinocchio: ") + c.entry->how();
    std::printf("  %-64s%9.3f%9.3f%9.3f%10.1f%9.3f%8.2f\n", who.c_str(), r.p50, r.p99, r.p999, r.worst, r.best_p50,
                r.best_p50 / all.front().result.best_p50);
  }
  std::string required;
  if (std::isfinite(task.p50)) required += " p50 <= " + number(task.p50) + " us";
  if (std::isfinite(task.p999)) required += ", p99.9 <= " + number(task.p999) + " us";
  if (std::isfinite(task.ratio)) required += ", ratio >= " + number(task.ratio);
  std::printf("  %s%s; contestants differ by %.1e, by the last digit of q %.1e\n\n", required.empty() ? "nothing required" : "required:",
              required.c_str(), agreed.difference, agreed.sensitivity);
}

double load_average() {
  double load = none;
  return getloadavg(&load, 1) == 1 ? load : none;
}

/// Keeps to the core it is on; false where that is not allowed.
bool pin() {
  cpu_set_t set;
  CPU_ZERO(&set);
  CPU_SET(static_cast<unsigned>(sched_getcpu()), &set);
  return sched_setaffinity(0, sizeof set, &set) == 0;
}

}  // namespace

int main(int argc, char** argv) {
  int calls = 1'000'000;
  const char* only = nullptr;
  bool json = false;
  for (int i = 1; i < argc; ++i) {
    if (std::strcmp(argv[i], "--json") == 0) json = true;
    else if (std::strcmp(argv[i], "--calls") == 0 && i + 1 < argc) calls = std::max(1, std::atoi(argv[++i]));
    else if (std::strcmp(argv[i], "--arm") == 0 && i + 1 < argc) only = argv[++i];
    else {
      std::fprintf(stderr, "usage: %s [--calls N] [--arm NAME] [--json]\n", argv[0]);
      return 2;
    }
  }
  const bool pinned = pin();
  const Clock clock = calibrate();
  const int blocks_per_round = (calls + rounds * block - 1) / (rounds * block);
  const double load_before = load_average();
  bool agreed = true, first_arm = true;
  if (json) std::printf("{\"arms\": [");
  for (const Robot& robot : robots()) {
    if (only != nullptr && robot.name != only) continue;
    const std::vector<JointSample> samples = measured_motion(Arm(robot.arm));
    if (json) std::printf("%s\n    {\"arm\": \"%s\", \"joints\": %d, \"tasks\": [", first_arm ? "" : ",", robot.name.c_str(), robot.arm.n);
    else std::printf("=== %s: %d joints, %g kHz, %d calls, times in us\n\n", robot.name.c_str(), robot.arm.n, 1e-3 / dt, rounds * blocks_per_round * block);
    bool first_task = true;
    for (const Task& task : tasks) {
      std::vector<Contestant> all = contestants(robot.arm, task.job);
      const Agreement found = agreement(all, *ours(robot.arm, task.job), samples);
      agreed = agreed && found.holds();
      measure(all, samples, blocks_per_round, clock);
      if (json) print_json(task, found, all, first_task);
      else print_table(task, found, all);
      std::fflush(stdout);
      first_task = false;
    }
    if (json) std::printf("]}");
    first_arm = false;
  }
  rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  if (json) {
    std::printf("],\n  \"pinned\": %s, \"clock_overhead_ns\": %s, \"preempted\": %ld, \"load_before\": %s, \"load_after\": %s}\n", pinned ? "true" : "false",
                number(1e3 * clock.overhead / clock.ticks_per_us).c_str(), usage.ru_nivcsw, number(load_before).c_str(), number(load_average()).c_str());
  } else {
    std::printf("%s core; reading the clock takes %.0f ns (subtracted); preempted %ld times; load average %.1f before, %.1f after.\n"
                "Quantiles and worst include what else the machine did: other processes, interrupts, the hypervisor.\n",
                pinned ? "One" : "Not pinned to a", 1e3 * clock.overhead / clock.ticks_per_us, usage.ru_nivcsw, load_before, load_average());
  }
  if (first_arm) std::fprintf(stderr, "no arm %s; there are justina_left_arm_box and 'kuka_lbr_iiwa14 with dry friction and encoders'\n", only);
  if (!agreed) std::fprintf(stderr, "contestants differ by more than 1e-9 and than rounding does: they do not compute the same, so times cannot be compared\n");
  return agreed && !first_arm ? 0 : 1;
}
