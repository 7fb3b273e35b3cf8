// SenderClock and JointVelocity: the sender's cycles are counted right, its period is found, garbage is refused.
#include "palpate/sender_clock.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "no_alloc.hpp"
#include "palpate/velocity.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

struct Look {
  std::int64_t time_ns;
  JointVector q;
  int cycles;   // truly new since the look before
  double age;   // of the sample, truly [s]
};
/// Two joints on a smooth path, sent every T, read every h with stamps that are off by up to `jitter` and rounded to 1 ms.
std::vector<Look> looks(double T, double h, double seconds, double jitter, std::uint64_t seed, double rest = 0.0) {
  Random r(seed);
  const auto path = [&](double t) {
    const double s = std::max(0.0, t - rest);
    return JointVector{0.4 * std::sin(0.7 * s), 0.3 * s + 0.05 * std::sin(2.0 * s)};
  };
  std::vector<Look> out;
  std::int64_t k = -1;
  const double offset = r(0.0, T);
  for (double t = 1.0; t < 1.0 + seconds; t += h * (1.0 + 0.002 * r(-1.0, 1.0))) {
    const auto now = static_cast<std::int64_t>(std::floor((t - offset) / T));
    const double sent = offset + T * static_cast<double>(now);
    JointVector q = path(sent - 1.0);
    for (std::size_t j = 0; j < 2; ++j) q[j] += 2e-6 * r.normal();
    if (k == now) q = out.back().q;
    const double stamp = t + jitter * r(0.0, 1.0);
    out.push_back({static_cast<std::int64_t>(std::floor(stamp * 1e3)) * 1'000'000, q, k < 0 ? 0 : static_cast<int>(now - k), t - sent});
    k = now;
  }
  return out;
}

TEST(SenderClock, FindsThePeriodAndCountsTheCycles) {
  // below, near and above one cycle per look; 1.62 is the whiteboard project's
  for (const auto& [T, h] : {std::pair{0.005, 0.00813}, {0.004, 0.0105}, {0.005, 0.0061}, {0.010, 0.0071}, {0.002, 0.0073}}) {
    for (std::uint64_t seed : {1u, 2u, 3u}) {
      SenderClock clock(2);
      int wrong = 0, judged = 0;
      for (const Look& l : looks(T, h, 8.0, 2e-4, seed)) {
        const SenderStamp s = clock.step(l.time_ns, l.q);
        if (s.status != Status::ok) continue;
        ++judged;
        wrong += s.cycles != l.cycles;
        EXPECT_EQ(s.fresh, s.cycles > 0);
        EXPECT_NEAR(static_cast<double>(l.time_ns - s.time_ns) * 1e-9, l.age, 0.003);
      }
      EXPECT_GT(judged, static_cast<int>(7.0 / h)) << T << " " << h;
      EXPECT_LE(wrong, judged / 500) << T << " " << h;
      EXPECT_NEAR(clock.period(), T, 0.001 * T) << T << " " << h;
    }
  }
}

TEST(SenderClock, AGivenPeriodIsUsed) {
  SenderClock clock(2, {.period = 0.005});
  int wrong = 0;
  for (const Look& l : looks(0.005, 0.00813, 5.0, 2e-4, 4)) {
    const SenderStamp s = clock.step(l.time_ns, l.q);
    wrong += s.status == Status::ok && s.cycles != l.cycles;
  }
  EXPECT_EQ(wrong, 0);
  EXPECT_NEAR(clock.period(), 0.005, 2e-6);
}

TEST(SenderClock, KeepsCountingAfterARestInTheMiddle) {
  // moves, stands for 3 s (encoder noise only), moves again: the period is known, where in the cycle is found again
  std::vector<Look> all = looks(0.005, 0.00813, 4.0, 2e-4, 5);
  const Look last = all.back();
  Random r(6);
  for (int k = 1; k <= 370; ++k) {
    Look l = last;
    l.time_ns += static_cast<std::int64_t>(8.13e6 * k);
    l.q[0] += 2e-6 * r.normal();
    all.push_back(l);
  }
  const std::int64_t shift = all.back().time_ns - 1'000'000'000 + 8'000'000;
  const std::size_t again = all.size();
  for (Look l : looks(0.005, 0.00813, 4.0, 2e-4, 5)) {
    for (std::size_t j = 0; j < 2; ++j) l.q[j] += last.q[j];
    l.time_ns += shift;
    all.push_back(l);
  }
  SenderClock clock(2);
  int wrong = 0;
  for (std::size_t i = 0; i < all.size(); ++i) {
    const SenderStamp s = clock.step(all[i].time_ns, all[i].q);
    if (i > again + 20 && s.status == Status::ok) wrong += s.cycles != all[i].cycles;
    if (i > again) EXPECT_EQ(s.status, Status::ok);
  }
  EXPECT_LE(wrong, 3);
}

TEST(SenderClock, AReaderThatIsInStepIsLeftAlone) {
  SenderClock clock(2);
  Status last = Status::warming;
  for (int k = 0; k < 200; ++k) {
    const std::int64_t t = 1'000'000'000 + 4'000'000ll * k;
    const SenderStamp s = clock.step(t, {0.002 * k, -0.001 * k});
    EXPECT_EQ(s.time_ns, t);
    if (k > 0) EXPECT_DOUBLE_EQ(s.interval, 0.004);
    last = s.status;
  }
  EXPECT_EQ(last, Status::ok);
  EXPECT_EQ(clock.period(), 0.0);
}

TEST(SenderClock, MemoryThatNobodyHasWrittenToIsNoMeasurement) {
  // as in two real logs: 135 equal rows, then the first real position 1.5 rad away
  SenderClock clock(2);
  JointVelocity velocity(2);
  const std::vector<Look> real = looks(0.005, 0.00813, 3.0, 2e-4, 7);
  double largest = 0.0;
  for (int k = 0; k < 135; ++k) {
    const std::int64_t t = 1'000'000'000 + 8'130'000ll * k;
    const SenderStamp s = clock.step(t, {-0.2546, 1.0});
    EXPECT_FALSE(s.fresh);
    EXPECT_EQ(s.status, Status::warming);
    EXPECT_EQ(velocity.step(t, {-0.2546, 1.0}), JointVector{});
    EXPECT_EQ(velocity.status(), Status::warming);
  }
  for (std::size_t i = 0; i < real.size(); ++i) {
    const std::int64_t t = real[i].time_ns + 135 * 8'130'000ll;
    const SenderStamp s = clock.step(t, real[i].q);
    const JointVector& v = velocity.step(t, real[i].q);
    if (i == 0) {
      EXPECT_EQ(s.status, Status::gap);
      EXPECT_EQ(s.interval, 0.0);
      EXPECT_EQ(velocity.status(), Status::gap);
    }
    for (double x : v) largest = std::max(largest, std::abs(x));
  }
  EXPECT_LT(largest, 1.0);
}

TEST(SenderClock, RefusesWhatIsNoNumberAndTimeThatStandsStill) {
  SenderClock clock(2);
  const std::vector<Look> all = looks(0.005, 0.00813, 2.0, 2e-4, 8);
  SenderClock undisturbed(2);
  for (const Look& l : all) {
    const SenderStamp s = clock.step(l.time_ns, l.q), u = undisturbed.step(l.time_ns, l.q);
    EXPECT_EQ(s.time_ns, u.time_ns);
    EXPECT_EQ(s.cycles, u.cycles);
    EXPECT_EQ(clock.step(l.time_ns + 1, {nan, 0.0}).status, Status::non_finite);
    EXPECT_EQ(clock.step(l.time_ns, l.q).status, Status::time_error);
    EXPECT_FALSE(clock.value().fresh);
  }
}

TEST(SenderClock, StampsRiseWhateverComes) {
  Random r(9);
  SenderClock clock(2);
  std::int64_t t = 0, before = std::numeric_limits<std::int64_t>::min();
  JointVector q{};
  for (int k = 0; k < 20000; ++k) {
    t += static_cast<std::int64_t>(r(1.0, r(0.0, 1.0) < 0.01 ? 4e8 : 2e7));
    for (std::size_t j = 0; j < 2; ++j)
      if (r(0.0, 1.0) < 0.8) q[j] += r(0.0, 1.0) < 0.003 ? 5.0 : 0.001 * r.normal();
    const SenderStamp s = clock.step(t, q);
    if (s.status == Status::ok && s.fresh) {
      EXPECT_GT(s.interval, 0.0);
      EXPECT_GT(s.time_ns, before);
      before = s.time_ns;
    } else if (s.status == Status::gap) {
      before = std::numeric_limits<std::int64_t>::min();
    }
  }
}

TEST(SenderClock, ChunkedRunIsWholeRunResetIsNewAndNothingIsAllocated) {
  const std::vector<Look> all = looks(0.005, 0.00813, 3.0, 2e-4, 10);
  SenderClock whole(2), chunk(2);
  for (const Look& l : looks(0.002, 0.0071, 2.0, 2e-4, 11)) chunk.step(l.time_ns, l.q);
  chunk.reset();
  palpate::test::AllocationCounter counter;
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (i == all.size() / 2) chunk = SenderClock(chunk);
    EXPECT_EQ(whole.step(all[i].time_ns, all[i].q).time_ns, chunk.step(all[i].time_ns, all[i].q).time_ns);
  }
  EXPECT_EQ(counter.count(), 0u);
}

TEST(JointVelocity, OnTheSendersClockHasTheNoiseOfTheEncoderOnly) {
  for (std::uint64_t seed : {1u, 2u, 3u}) {
    JointVelocity plain(2, {.recover_clock = false}), recovered(2);
    const std::vector<Look> all = looks(0.005, 0.00813, 6.0, 2e-4, seed);
    double p = 0.0, s = 0.0;
    int count = 0;
    for (std::size_t i = 0; i < all.size(); ++i) {
      const double a = plain.step(all[i].time_ns, all[i].q)[1], b = recovered.step(all[i].time_ns, all[i].q)[1];
      if (i < 150) continue;
      const double t = static_cast<double>(all[i].time_ns) * 1e-9 - all[i].age - 1.0 - 0.004;
      const double truth = 0.3 + 0.1 * std::cos(2.0 * t);
      p += (a - truth) * (a - truth);
      s += (b - truth) * (b - truth);
      ++count;
    }
    EXPECT_GT(std::sqrt(p / count), 0.07);
    EXPECT_LT(std::sqrt(s / count), 0.005);
  }
}

TEST(JointVelocity, ThePublishedFiltersAreTheirFormulas) {
  const double h = 0.008;
  JointVelocity mean(1, {.recover_clock = false, .average = 5}), lag(1, {.recover_clock = false, .time_constant = 5 * h});
  Random r(3);
  std::vector<double> raw;
  JointVector q{};
  double y = 0.0;
  for (int k = 0; k < 100; ++k) {
    const std::int64_t t = 8'000'000ll * k;
    const double before = q[0];
    q[0] += 1e-3 * r.normal();
    const double m = mean.step(t, q)[0], l = lag.step(t, q)[0];
    if (k == 0) continue;
    raw.push_back((q[0] - before) / h);
    y = k == 1 ? raw[0] : (1.0 - 1.0 / 6.0) * y + raw.back() / 6.0;
    double sum = 0.0;
    const std::size_t n = std::min<std::size_t>(raw.size(), 5);
    for (std::size_t i = raw.size() - n; i < raw.size(); ++i) sum += raw[i];
    EXPECT_NEAR(m, sum / static_cast<double>(n), 1e-12);
    EXPECT_NEAR(l, y, 1e-12);
  }
}

TEST(JointVelocity, TheFirstPositionHasNoVelocity) {
  for (bool recover : {false, true}) {
    JointVelocity v(1, {.recover_clock = recover});
    EXPECT_EQ(v.step(1'000'000'000, {1.5})[0], 0.0);
    EXPECT_EQ(v.status(), Status::warming);
  }
}

TEST(JointVelocity, ConstructorNamesWhatIsWrong) {
  const auto message = [](const JointVelocityConfig& c) -> std::string {
    try {
      JointVelocity v(1, c);
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message({.average = 65}), "MovingAverage window [samples] = 65: expected an integer from 1 to 64");
  EXPECT_EQ(message({.sender = {.period = 0.001}}),
            "SenderClockConfig period [s] = 0.001: expected more than twice stamp_std, or the stamps tell no cycles apart");
  EXPECT_EQ(message({.sender = {.stamp_std = 0.0}}), "SenderClockConfig stamp_std [s] = 0: expected a finite number > 0");
}

}  // namespace
