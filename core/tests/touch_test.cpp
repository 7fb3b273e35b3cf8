// Wrench and contact inside the pipeline: nothing allocated, the same bits after a reset, off unless asked for.
#include <gtest/gtest.h>

#include <vector>

#include "no_alloc.hpp"
#include "palpate/pipeline.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

std::shared_ptr<const Arm> arm(int n) {
  Random r(8);
  ArmDescription d = palpate_test::random_description(r, n);
  for (auto& joint : d.joints) {
    joint.prismatic = false;
    joint.position_std = 1e-6;
    joint.torque_std = 0.05;
  }
  return std::make_shared<const Arm>(d);
}
std::vector<RawSample> samples(const Arm& a, int count) {
  Random r(2);
  std::vector<RawSample> out;
  for (int k = 0; k < count; ++k) {
    RawSample s;
    s.time_ns = k * 1'000'000ll;
    for (std::size_t j = 0; j < static_cast<std::size_t>(a.n()); ++j) s.position[j] = 0.3 * static_cast<double>(j) + 1e-6 * r.normal();
    const JointVector g = gravity_torque<double>(a, s.position);
    for (std::size_t j = 0; j < static_cast<std::size_t>(a.n()); ++j) s.effort[j] = g[j] + 0.05 * r.normal() - (k > 500 && k < 700 ? 8.0 : 0.0);
    if (k == 300) s.position[0] = std::nan("");
    out.push_back(s);
  }
  return out;
}
const PipelineConfig feeling{.observer = DisturbanceKalmanConfig{}, .payload = std::monostate{}, .wrench = WrenchConfig{}, .contact = ContactConfig{}};

TEST(TouchPipeline, FeelsAllocatesNothingAndForgetsOnReset) {
  const auto a = arm(7);
  const std::vector<RawSample> raw = samples(*a, 1000);
  Pipeline pipeline(a, feeling);
  std::vector<Touch> first(raw.size());
  const palpate::test::AllocationCounter counter;
  for (std::size_t k = 0; k < raw.size(); ++k) first[k] = pipeline.step(raw[k]);
  EXPECT_EQ(counter.count(), 0u);
  EXPECT_EQ(first[300].contact.status, Status::held);
  EXPECT_EQ(first[300].wrench.status, Status::held);
  EXPECT_TRUE(first[600].contact.active);
  EXPECT_EQ(first[600].contact.count, 1u);
  EXPECT_FALSE(first[999].contact.active);
  EXPECT_GT(first[600].wrench.force_std[0], 0.0);
  pipeline.reset();
  for (std::size_t k = 0; k < raw.size(); ++k) {
    const Touch again = pipeline.step(raw[k]);
    ASSERT_EQ(again.wrench.force, first[k].wrench.force) << k;
    ASSERT_EQ(again.wrench.covariance, first[k].wrench.covariance) << k;
    ASSERT_EQ(again.contact.torque, first[k].contact.torque) << k;
    ASSERT_EQ(again.contact.level, first[k].contact.level) << k;
  }
}

TEST(TouchPipeline, OffUnlessAskedFor) {
  const auto a = arm(3);
  Pipeline pipeline(a, {.observer = MomentumConfig{}, .payload = std::monostate{}});
  for (const RawSample& raw : samples(*a, 50)) {
    const Touch touch = pipeline.step(raw);
    EXPECT_EQ(touch.wrench.status, Status::held);
    EXPECT_EQ(touch.contact.status, Status::held);
    EXPECT_EQ(touch.contact.link, -1);
  }
}

TEST(TouchPipeline, AWrenchNeedsAnObserver) {
  EXPECT_THROW(Pipeline(arm(3), {.payload = std::monostate{}, .wrench = WrenchConfig{}}), std::invalid_argument);
  EXPECT_NO_THROW(Pipeline(arm(3), {.payload = std::monostate{}, .contact = ContactConfig{}}));
}

}  // namespace
