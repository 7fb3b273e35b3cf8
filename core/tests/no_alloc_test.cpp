// The allocation counter counts: otherwise every "allocates nothing" test would pass by itself.
#include "no_alloc.hpp"

#include <gtest/gtest.h>

#include <functional>
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>

namespace {

using palpate::test::AllocationCounter;

struct alignas(64) Wide {
  double lane[8];
};

// The compiler may not look through these and leave the allocation out.
[[gnu::noinline]] void keep(const void* p) { asm volatile("" : : "r"(p) : "memory"); }

TEST(NoAlloc, CountsNothingWhereNothingIsAllocated) {
  AllocationCounter counter;
  double sum = 0.0;
  for (int i = 0; i < 1000; ++i) sum += i;
  keep(&sum);
  EXPECT_EQ(counter.count(), 0u);
}

TEST(NoAlloc, CountsPlainAlignedAndContainerAllocations) {
  AllocationCounter plain;
  auto one = std::make_unique<double>(1.0);
  keep(one.get());
  EXPECT_EQ(plain.count(), 1u);

  AllocationCounter aligned;
  auto wide = std::make_unique<Wide>();
  keep(wide.get());
  EXPECT_EQ(aligned.count(), 1u);

  AllocationCounter container;
  std::vector<int> v(100);
  keep(v.data());
  EXPECT_EQ(container.count(), 1u);
}

TEST(NoAlloc, CountsCapturesTooLargeForAFunctionObject) {
  AllocationCounter counter;
  const Wide wide{};
  std::function<double()> f = [wide] { return wide.lane[0]; };
  keep(&f);
  EXPECT_GE(counter.count(), 1u);
}

#if defined(__GLIBC__) && !defined(PALPATE_COUNT_OPERATOR_NEW)
TEST(NoAlloc, CountsThrownExceptions) {
  AllocationCounter counter;
  try {
    throw std::runtime_error("x");
  } catch (const std::runtime_error& e) {
    keep(&e);
  }
  EXPECT_GE(counter.count(), 1u);
}
#endif

TEST(NoAlloc, LeavesOtherThreadsOut) {
  std::size_t inside = 0;
  AllocationCounter counter;
  std::thread other([&inside] {
    AllocationCounter own;
    for (int i = 0; i < 100; ++i) {
      auto p = std::make_unique<int>(i);
      keep(p.get());
    }
    inside = own.count();
  });
  other.join();
  EXPECT_EQ(inside, 100u);
  EXPECT_LT(counter.count(), 50u);  // starting a thread allocates a little here
}

}  // namespace
