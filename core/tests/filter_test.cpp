// Filters against closed forms, scipy, and the laws every filter keeps.
#include "palpate/filter.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <random>
#include <vector>

#include "no_alloc.hpp"

using namespace palpate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

// The input and the irregular time steps of all scipy figures below: exact rationals, the same in both languages.
double input(int k) { return (37 * k) % 101 / 101.0 - 0.5; }
double irregular_dt(int k) { return 0.001 * (1 + (7 * k) % 11); }

constexpr std::array<int, 7> sampled{0, 1, 2, 10, 50, 199, 399};
using Reference = std::array<double, 7>;

template <class Step>
void expect_scipy(const Reference& reference, double tolerance, Step&& step) {
  std::size_t i = 0;
  for (int k = 0; k < 400; ++k) {
    const double y = step(k);
    if (i == sampled.size() || sampled[i] != k) continue;
    EXPECT_NEAR(y, reference[i], tolerance) << "sample " << k;
    ++i;
  }
  EXPECT_EQ(i, sampled.size());
}

// ---------------------------------------------------------------------------------------------- FirstOrder

TEST(FirstOrder, ExactAgreesWithScipy) {
  // y = Ad y + Bd x with Ad, Bd from scipy.signal.cont2discrete((-50, 50, 1, 0), dt, "zoh")
  FirstOrder<1> f(1, 0.02, Lag::exact, Start::zero);
  expect_scipy({-0.024385287749642996, -0.06041207966751588, -0.0072847195339900694, -0.046587384891479136, -0.0552941655405666,
                0.14180967567099534, -0.12839229728156906},
               1e-15, [&](int k) { return f.step(input(k), irregular_dt(k)); });
}

TEST(FirstOrder, PublishedFormIsTheWhiteboardRecursion) {
  const double h = 0.008;
  for (double factor : {2.0, 5.0, 10.0}) {  // tau_f = 2h, 5h, 10h
    FirstOrder<1> f(1, factor * h, Lag::published, Start::zero);
    double v = 0.0;
    for (int k = 0; k < 100; ++k) {
      v = (1.0 - 1.0 / (1.0 + factor)) * v + 1.0 / (1.0 + factor) * input(k);
      EXPECT_NEAR(f.step(input(k), h), v, 1e-15);
    }
  }
}

TEST(FirstOrder, ExactStepResponseAndSplitSteps) {
  FirstOrder<1> whole(1, 0.5, Lag::exact, Start::zero), split = whole;
  EXPECT_NEAR(whole.step(1.0, 0.5), 1.0 - std::exp(-1.0), 1e-16);
  for (double part : {0.1, 0.25, 0.15}) split.step(1.0, part);
  EXPECT_NEAR(split.value()[0], whole.value()[0], 1e-15);
}

TEST(FirstOrder, ZeroTimeConstantPassesThroughAndZeroTimeStepHolds) {
  for (Lag lag : {Lag::exact, Lag::published}) {
    FirstOrder<1> none(1, 0.0, lag);
    for (int k = 0; k < 20; ++k) EXPECT_EQ(none.step(input(k), irregular_dt(k)), input(k));
    FirstOrder<1> f(1, 0.1, lag);
    f.step(1.0, 0.01);
    EXPECT_EQ(f.step(5.0, 0.0), 1.0);
    EXPECT_EQ(f.status(), Status::ok);
  }
}

TEST(FirstOrder, RefusesImpossibleTimeSteps) {
  FirstOrder<1> f(1, 0.1);
  f.step(1.0, 0.01);
  for (double dt : {-0.01, nan, inf}) {
    EXPECT_EQ(f.step(2.0, dt), 1.0);
    EXPECT_EQ(f.status(), Status::time_error);
  }
}

// ------------------------------------------------------------------------------------------- MovingAverage

TEST(MovingAverage, IsTheMeanOfTheWindow) {
  MovingAverage<64, 1> f(1, 5);
  for (int k = 0; k < 200; ++k) {
    const int m = std::min(k + 1, 5);
    double mean = 0.0;
    for (int i = 0; i < m; ++i) mean += input(k - i) / m;
    EXPECT_NEAR(f.step(input(k)), mean, 1e-15);
    EXPECT_EQ(f.status(), m < 5 ? Status::warming : Status::ok);
  }
}

TEST(MovingAverage, ForgetsALargeValueCompletely) {
  MovingAverage<8, 1> f(1, 4);
  f.step(1e17);
  for (int k = 0; k < 4; ++k) f.step(0.1);
  EXPECT_EQ(f.value()[0], 0.1);
}

TEST(MovingAverage, ResultDoesNotDependOnTheRingsPhase) {
  for (int lead = 0; lead < 7; ++lead) {
    MovingAverage<8, 1> a(1, 7), b(1, 7);
    for (int k = 0; k < lead; ++k) a.step(0.3);
    for (int k = 0; k < 7; ++k) {
      a.step(input(k));
      b.step(input(k));
    }
    EXPECT_EQ(a.value()[0], b.value()[0]);
  }
}

// --------------------------------------------------------------------------------------------- Butterworth

TEST(Butterworth, UnitsAreNamed) {
  EXPECT_DOUBLE_EQ(Butterworth::from_hz(4, 1.0).cutoff_rad_per_s(), 2.0 * std::numbers::pi);
  EXPECT_DOUBLE_EQ(Butterworth::from_rad_per_s(4, 1.0).cutoff_hz(), 0.5 / std::numbers::pi);
}

TEST(Butterworth, FourthOrderHasThePublishedDenominator) {
  // justina_full_system.slx: [1, 2.6131259297527523, 3.414213562373094, 2.6131259297527523, 1]
  const Butterworth b = Butterworth::from_rad_per_s(4, 1.0);
  const double a = 2.0 * std::sin(b.angle(0)), c = 2.0 * std::sin(b.angle(1));
  EXPECT_NEAR(a + c, 2.6131259297527523, 1e-15);
  EXPECT_NEAR(2.0 + a * c, 3.414213562373094, 2e-15);
}

TEST(BilinearButterworth, AgreesWithScipy) {
  // scipy.signal.sosfilt(scipy.signal.butter(order, hz, fs=250, output="sos"), x)
  struct Case {
    int order;
    double hz;
    Reference y;
  };
  const std::array<Case, 6> cases{{
      {1,
       5.0,
       {-0.029595351909202722, -0.06359879312808996, -0.05020941274898972, -0.001454077768179584, 0.026023686196119968,
        0.009551625065529389, -0.0009447876822825906}},
      {2,
       5.0,
       {-0.0018108407574643208, -0.007406377916982019, -0.013919909360211528, -0.032496459798096074, -0.0025293841296728722,
        -0.0011484426409249437, -0.000646571565858273}},
      {3,
       20.0,
       {-0.00509128836821847, -0.026836813378028145, -0.06339593380923587, 0.022244910988799015, -0.00337041872809842, -0.02956989164935219,
        0.023986008251093035}},
      {4,
       0.5 / std::numbers::pi,
       {-7.958341461804027e-12, -6.57110245480996e-11, -2.672128959799628e-10, -2.5280509910295584e-08, -3.0345782868070394e-06,
        -0.00013021593604972773, -0.0008488871313496489}},
      {5,
       40.0,
       {-0.004501816715807029, -0.03171296109632128, -0.09743237285991581, 0.05901597189922567, 0.06182596475997512, -0.09378143521509785,
        -0.0810109581244587}},
      {8,
       30.0,
       {-4.1092135536492795e-05, -0.0005099998234181309, -0.003000938820748684, -0.10097616085401888, -0.14368482534006735,
        0.06829977954054298, 0.1339234015122984}},
  }};
  for (const Case& c : cases) {
    SCOPED_TRACE(c.order);
    BilinearButterworth<1> f(Butterworth::from_hz(c.order, c.hz), 1, 1.0 / 250, Warp::prewarped, Start::zero);
    expect_scipy(c.y, 2e-13, [&](int k) { return f.step(input(k)); });
  }
}

TEST(BilinearButterworth, PlainTransformAgreesWithScipy) {
  // b, a = butter(order, 2 pi 20, analog=True); lfilter(*scipy.signal.bilinear(b, a, 250), x)
  const Reference fourth{-0.0010401764570204352, -0.0072669287092525705, -0.02359428607756643, -0.04170732268010186,
                         -0.04970631997645082,   0.021121244249385326,   0.06974481058168108};
  const Reference third{-0.004825700744853796, -0.025532891381187365, -0.060676583745606534, 0.017390442979236337,
                        -0.006763691530156312, -0.02564219381144624,  0.026970759971377316};
  BilinearButterworth<1> f4(Butterworth::from_hz(4, 20), 1, 1.0 / 250, Warp::plain, Start::zero);
  BilinearButterworth<1> f3(Butterworth::from_hz(3, 20), 1, 1.0 / 250, Warp::plain, Start::zero);
  expect_scipy(fourth, 1e-13, [&](int k) { return f4.step(input(k)); });
  expect_scipy(third, 1e-13, [&](int k) { return f3.step(input(k)); });
}

TEST(BilinearButterworth, PrewarpedGainAtCutoffIsMinusThreeDecibel) {
  for (int order = 1; order <= Butterworth::max_order; ++order) {
    const double hz = 25.0, h = 0.004;
    BilinearButterworth<1> f(Butterworth::from_hz(order, hz), 1, h);
    double in_phase = 0.0, quadrature = 0.0;
    for (int k = 0; k < 2000; ++k) {
      const double angle = 2.0 * std::numbers::pi * hz * h * k;
      const double y = f.step(std::sin(angle));
      if (k < 1000) continue;  // 100 whole periods of the settled output
      in_phase += y * std::sin(angle) / 500.0;
      quadrature += y * std::cos(angle) / 500.0;
    }
    EXPECT_NEAR(std::hypot(in_phase, quadrature), std::sqrt(0.5), 1e-9) << "order " << order;
  }
}

TEST(HeldButterworth, AgreesWithTheMatrixExponentialOfTheWholeCascade) {
  // x' = A x + B u, y = C x: the sections of butter(order, w, analog=True) in series; per step
  // E = scipy.linalg.expm([[A dt, B dt], [0, 0]]); x = E[:n, :n] x + E[:n, n:] u
  struct Case {
    int order;
    double w;
    Reference y;
  };
  const std::array<Case, 7> cases{{
      {1,
       30.0,
       {-0.01477723322574591, -0.04014422173714248, -0.00929413921787782, -0.0612264739418361, -0.04666712645978358, 0.11707308913435513,
        -0.10138608165062035}},
      {2,
       30.0,
       {-0.00022183489398147066, -0.006608405811202112, -0.009056932147194774, -0.09036092309288227, -0.03256043085327639,
        0.08413584205318735, -0.05774269953493691}},
      {3,
       60.0,
       {-1.7466447600013716e-05, -0.004663371181394694, -0.009929704592486847, -0.13234075438802623, -0.027550438949858855,
        0.09041761133202286, -0.036341916596576686}},
      {4,
       1.0,
       {-2.0822447679335496e-14, -7.378532697917736e-11, -2.725551767420842e-10, -1.1950079378656284e-07, -3.357252179252828e-05,
        -0.0016722619016029195, 0.0025936423928661365}},
      {4,
       50.0,
       {-1.26842670154619e-07, -0.0003562414191090582, -0.0011662957057483356, -0.10234648016325547, -0.039877191805505335,
        0.09976399386907234, -0.064793955052008}},
      {5,
       80.0,
       {-1.3075010477338029e-08, -0.0003106789694862295, -0.0013638943187865653, -0.15703120053484187, -0.021356661834917707,
        0.13492476265598752, -0.056309725252471174}},
      {8,
       100.0,
       {-1.171235203677315e-13, -2.1980522932852894e-06, -2.7629182895167984e-05, -0.13758815781327777, -0.025182818895704596,
        0.15339185467353722, -0.1141973962763288}},
  }};
  for (const Case& c : cases) {
    SCOPED_TRACE(c.order);
    HeldButterworth<1> f(Butterworth::from_rad_per_s(c.order, c.w), 1, Start::zero);
    expect_scipy(c.y, 1e-14, [&](int k) { return f.step(input(k), irregular_dt(k)); });
  }
}

TEST(HeldButterworth, SamplingItFasterChangesNothing) {
  std::mt19937 random(1);
  for (int order = 1; order <= Butterworth::max_order; ++order) {
    const Butterworth design = Butterworth::from_rad_per_s(order, 40.0);
    HeldButterworth<1> slow(design, 1, Start::zero), fast = slow;
    for (int k = 0; k < 300; ++k) {
      const double dt = irregular_dt(k);
      const double y = slow.step(input(k), dt);
      const double cut = dt * std::uniform_real_distribution<double>(0.0, 1.0)(random);
      fast.step(input(k), cut);
      EXPECT_NEAR(fast.step(input(k), dt - cut), y, 3e-14) << "order " << order << " sample " << k;
    }
  }
}

TEST(HeldButterworth, SettlingTimeTellsHertzFromRadianPerSecond) {
  // 5 % settling of the report's filter at 1 rad/s and 1 Hz, scipy.signal.step: 6.8523 s and 1.0906 s (MATH.md 1, R3)
  const auto settling = [](const Butterworth& design) {
    HeldButterworth<1> f(design, 1, Start::zero);
    double last_outside = 0.0;
    for (int k = 1; k <= 20000; ++k)
      if (std::abs(f.step(1.0, 0.001) - 1.0) > 0.05) last_outside = 0.001 * k;
    return last_outside;
  };
  EXPECT_NEAR(settling(Butterworth::from_rad_per_s(4, 1.0)), 6.8523, 0.0015);
  EXPECT_NEAR(settling(Butterworth::from_hz(4, 1.0)), 1.0906, 0.0015);
}

TEST(HeldButterworth, SurvivesTimeStepsOfAnySize) {
  for (int order = 1; order <= Butterworth::max_order; ++order) {
    HeldButterworth<1> f(Butterworth::from_rad_per_s(order, 1e3), 1, Start::zero);
    for (double dt : {0.0, 1e-300, 1e-9, 1.0, 1e6, 1e300, std::numeric_limits<double>::max()})
      EXPECT_TRUE(std::isfinite(f.step(1.0, dt))) << dt;
    EXPECT_EQ(f.value()[0], 1.0);
    f.step(2.0, -1.0);
    EXPECT_EQ(f.status(), Status::time_error);
    EXPECT_EQ(f.value()[0], 1.0);
  }
}

// ------------------------------------------------------------------------------------------ Differentiator

constexpr std::int64_t ms = 1000000;

TEST(Differentiator, FirstSampleHasNoVelocity) {
  Differentiator<1> d(1);
  EXPECT_EQ(d.step(5 * ms, {1.5})[0], 0.0);  // not 1.5/dt, whiteboard erratum 5
  EXPECT_EQ(d.status(), Status::warming);
  EXPECT_EQ(d.noise_gain(), inf);
  EXPECT_DOUBLE_EQ(d.step(9 * ms, {1.502})[0], 0.5);
  EXPECT_EQ(d.status(), Status::ok);
  EXPECT_DOUBLE_EQ(d.noise_gain(), std::sqrt(2.0) / 0.004);
  d.reset();
  EXPECT_EQ(d.noise_gain(), inf);
}

TEST(Differentiator, UsesTheRealTimeStampsAndRefusesRepeatedOnes) {
  Differentiator<1> d(1);
  d.step(0, {0.0});
  for (std::int64_t t : {3 * ms, 4 * ms, 30 * ms, 31 * ms + 1}) {
    EXPECT_NEAR(d.step(t, {2e-9 * static_cast<double>(t)})[0], 2.0, 1e-12);
    for (std::int64_t bad : {t, t - ms}) {
      EXPECT_NEAR(d.step(bad, {99.0})[0], 2.0, 1e-12);
      EXPECT_EQ(d.status(), Status::time_error);
    }
  }
}

TEST(Differentiator, LeastSquaresSlopeAgreesWithNumpy) {
  // t = numpy.cumsum(dt); numpy.polyfit(t[i-m+1:i+1] - t[i], x[i-m+1:i+1], 1)[0]
  const auto run = [](int points, const std::vector<std::pair<int, double>>& reference) {
    Differentiator<1> d(1, {.points = points});
    std::int64_t t = 0;
    std::size_t i = 0;
    for (int k = 0; k < 400; ++k) {
      t += ms * (1 + (7 * k) % 11);
      const double v = d.step(t, {input(k)})[0];
      EXPECT_EQ(d.status(), k + 1 < points ? Status::warming : Status::ok);
      if (i == reference.size() || reference[i].first != k) continue;
      EXPECT_NEAR(v, reference[i].second, 1e-12) << k;
      ++i;
    }
    EXPECT_EQ(i, reference.size());
  };
  run(7,
      {{6, 4.700551488373595}, {10, -0.8108930430680483}, {50, 4.7005514883735895}, {199, 8.55739540961176}, {399, -11.487687230261514}});
  run(16, {{15, 0.9180077039101463}, {50, -0.17958843594023546}, {199, 0.8025990599383446}, {399, -0.014041112377029461}});
}

TEST(Differentiator, NoiseGainIsTheSpreadOfTheSlope) {
  Differentiator<1> d(1, {.points = 9});
  std::mt19937 random(3);
  std::normal_distribution<double> noise(0.0, 1e-3);
  double sum = 0.0;
  const int N = 200000;
  for (int k = 0; k < N + 9; ++k) {
    const double v = d.step(k * ms, {noise(random)})[0];
    if (k >= 9) sum += v * v;
  }
  EXPECT_NEAR(std::sqrt(sum / N), 1e-3 * d.noise_gain(), 0.01 * 1e-3 * d.noise_gain());
  EXPECT_NEAR(d.noise_gain(), std::sqrt(12.0 / (9 * 80)) / 1e-3, 1e-9 * d.noise_gain());  // uniform period
}

TEST(Differentiator, LowPassActsOnTheVelocityFromTheFirstOneOn) {
  Differentiator<1> d(1, {.points = 2, .time_constant = 0.01, .lag = Lag::published});
  FirstOrder<1> f(1, 0.01, Lag::published);
  std::int64_t t = 0;
  d.step(t, {input(0)});
  for (int k = 1; k < 100; ++k) {
    const std::int64_t interval = ms * (1 + (7 * k) % 11);
    const double dt = static_cast<double>(interval) / 1e9;
    t += interval;
    EXPECT_EQ(d.step(t, {input(k)})[0], f.step((input(k) - input(k - 1)) / dt, dt));
  }
}

TEST(Differentiator, ExtremeTimeStampsDoNotOverflow) {
  Differentiator<1> d(1);
  d.step(std::numeric_limits<std::int64_t>::min(), {0.0});
  EXPECT_NEAR(d.step(std::numeric_limits<std::int64_t>::max(), {1.0})[0] * 1.8446744073709552e10, 1.0, 1e-15);
}

// --------------------------------------------------- laws: one adapter per filter, the same tests for each

constexpr int channels = 7;

struct FirstOrderLaw : FirstOrder<> {
  FirstOrderLaw() : FirstOrder<>(channels, 0.03) {}
  const JointVector& feed(int k, const JointVector& x) { return step(x, irregular_dt(k)); }
};
struct PublishedLaw : FirstOrder<> {
  PublishedLaw() : FirstOrder<>(channels, 0.03, Lag::published) {}
  const JointVector& feed(int k, const JointVector& x) { return step(x, irregular_dt(k)); }
};
struct MovingAverageLaw : MovingAverage<32> {
  MovingAverageLaw() : MovingAverage<32>(channels, 11) {}
  const JointVector& feed(int, const JointVector& x) { return step(x); }
};
struct BilinearLaw : BilinearButterworth<> {
  BilinearLaw() : BilinearButterworth<>(Butterworth::from_hz(5, 20), channels, 0.004) {}
  const JointVector& feed(int, const JointVector& x) { return step(x); }
};
struct HeldLaw : HeldButterworth<> {
  HeldLaw() : HeldButterworth<>(Butterworth::from_rad_per_s(7, 60), channels) {}
  const JointVector& feed(int k, const JointVector& x) { return step(x, irregular_dt(k)); }
};

template <class F>
class LowPassLaws : public ::testing::Test {
 protected:
  static JointVector at(int k) {
    JointVector x{};
    for (std::size_t j = 0; j < channels; ++j) x[j] = input(3 * k + static_cast<int>(j));
    return x;
  }
};
using LowPasses = ::testing::Types<FirstOrderLaw, PublishedLaw, MovingAverageLaw, BilinearLaw, HeldLaw>;
TYPED_TEST_SUITE(LowPassLaws, LowPasses);

TYPED_TEST(LowPassLaws, ZeroInZeroOut) {
  TypeParam f;
  for (int k = 0; k < 100; ++k) EXPECT_EQ(f.feed(k, {}), JointVector{});
}

TYPED_TEST(LowPassLaws, ConstantPassesExactlyFromTheFirstSample) {
  TypeParam f;
  JointVector x{};
  for (std::size_t j = 0; j < channels; ++j) x[j] = 0.1 + 1.7 * static_cast<double>(j);
  for (int k = 0; k < 500; ++k) EXPECT_EQ(f.feed(k, x), x);
}

TYPED_TEST(LowPassLaws, GainAtStandstillIsOne) {
  TypeParam f;
  for (int k = 0; k < 50; ++k) f.feed(k, this->at(k));
  JointVector x{};
  std::fill_n(x.begin(), channels, 0.7);
  for (int k = 0; k < 2000; ++k) f.feed(k, x);
  for (std::size_t j = 0; j < channels; ++j) EXPECT_NEAR(f.value()[j], 0.7, 1e-15);
}

TYPED_TEST(LowPassLaws, ChannelsDoNotMixAndUnusedOnesStayZero) {
  TypeParam all, one;
  for (int k = 0; k < 200; ++k) {
    const JointVector x = this->at(k);
    JointVector only{};
    only[3] = x[3];
    all.feed(k, x);
    one.feed(k, only);
    EXPECT_EQ(all.value()[3], one.value()[3]);
    for (std::size_t j = channels; j < max_joints; ++j) EXPECT_EQ(all.value()[j], 0.0);
  }
}

TYPED_TEST(LowPassLaws, ChunkedRunIsWholeRunAndResetIsNew) {
  TypeParam whole, used;
  for (int k = 0; k < 77; ++k) used.feed(k, this->at(5 * k));
  used.reset();
  EXPECT_EQ(used.status(), Status::warming);
  std::vector<JointVector> outputs;
  for (int k = 0; k < 300; ++k) outputs.push_back(whole.feed(k, this->at(k)));
  TypeParam chunk = used;
  for (int k = 0; k < 300; ++k) {
    if (k % 50 == 0) {  // carry on in a copy, as a run over the next chunk of a log does
      const TypeParam carried = chunk;
      chunk = carried;
    }
    EXPECT_EQ(chunk.feed(k, this->at(k)), outputs[static_cast<std::size_t>(k)]) << k;
  }
}

TYPED_TEST(LowPassLaws, ABadNumberIsNotUsed) {
  TypeParam good, bad;
  for (int k = 0; k < 60; ++k) {
    const JointVector expected = good.feed(k, this->at(k));
    for (double junk : {nan, inf, -inf}) {
      if (k == 0) break;
      JointVector x = this->at(k);
      x[4] = junk;
      const JointVector before = bad.value();
      EXPECT_EQ(bad.feed(k, x), before);
      EXPECT_EQ(bad.status(), Status::non_finite);
    }
    EXPECT_EQ(bad.feed(k, this->at(k)), expected);
  }
}

TYPED_TEST(LowPassLaws, AllocatesNothing) {
  TypeParam f;
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) f.feed(k, this->at(k));
  EXPECT_EQ(counter.count(), 0u);
}

TEST(DifferentiatorLaws, ChunkedResetConstantBadNumberAndAllocations) {
  const auto q = [](int k) {
    JointVector x{};
    for (std::size_t j = 0; j < channels; ++j) x[j] = input(k + static_cast<int>(j));
    return x;
  };
  const auto t = [](int k) { return std::int64_t{k} * 4 * ms + (k * k) % 3 * ms; };
  for (int points : {2, 5, 16}) {
    const DifferentiatorConfig config{.points = points, .time_constant = 0.005};
    Differentiator<> whole(channels, config), used(channels, config);
    for (int k = 0; k < 33; ++k) used.step(t(k), q(9 * k));
    used.reset();
    for (int k = 0; k < 100; ++k) {
      const JointVector v = whole.step(t(k), q(k));
      if (k == 50) used = Differentiator<>(used);
      JointVector junk = q(k);
      junk[6] = nan;
      used.step(t(k) - 1, junk);
      EXPECT_EQ(used.status(), Status::non_finite);
      EXPECT_EQ(used.step(t(k), q(k)), v);
      EXPECT_EQ(used.status(), whole.status());
    }
    Differentiator<> still(channels, config);
    for (int k = 0; k < 40; ++k) EXPECT_EQ(still.step(t(k), q(0)), JointVector{});
    palpate::test::AllocationCounter counter;
    for (int k = 40; k < 100; ++k) still.step(t(k), q(k));
    EXPECT_EQ(counter.count(), 0u);
  }
}

TEST(Filters, ConstructorsNameWhatIsWrong) {
  const auto message = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([] { (void)Butterworth::from_hz(9, 1.0); }), "Butterworth order = 9: expected an integer from 1 to 8");
  EXPECT_EQ(message([] { (void)Butterworth::from_hz(2, -1.0); }), "Butterworth cutoff [Hz] = -1: expected a finite number > 0");
  EXPECT_EQ(message([] { (void)Butterworth::from_rad_per_s(2, nan); }), "Butterworth cutoff [rad/s] = nan: expected a finite number > 0");
  EXPECT_EQ(message([] { BilinearButterworth<>(Butterworth::from_hz(2, 125.0), 7, 0.004); }),
            "Butterworth cutoff [Hz] = 125: expected less than half the sample rate, 125.000000 Hz");
  EXPECT_EQ(message([] { BilinearButterworth<>(Butterworth::from_hz(2, 1.0), 7, 0.0); }),
            "BilinearButterworth period [s] = 0: expected a finite number > 0");
  EXPECT_EQ(message([] { HeldButterworth<>(Butterworth::from_hz(2, 1.0), 17); }),
            "HeldButterworth n = 17: expected an integer from 1 to 16");
  EXPECT_EQ(message([] { FirstOrder<>(7, -0.1); }), "FirstOrder time_constant [s] = -0.1: expected a finite number >= 0");
  EXPECT_EQ(message([] { MovingAverage<8>(7, 9); }), "MovingAverage window [samples] = 9: expected an integer from 1 to 8");
  EXPECT_EQ(message([] { Differentiator<>(7, {.points = 1}); }), "Differentiator points = 1: expected an integer from 2 to 16");
}

}  // namespace
