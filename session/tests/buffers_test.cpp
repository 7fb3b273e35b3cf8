// Ring, Latest, Histogram: nothing lost, nothing torn, nothing out of order, whoever is slow. Also built with the thread sanitizer.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <thread>
#include <vector>

#include "no_alloc.hpp"
#include "palpate/session/histogram.hpp"
#include "palpate/session/latest.hpp"
#include "palpate/session/ring.hpp"

using namespace palpate;

namespace {

constexpr std::uint64_t many = 200'000;

/// Large enough to be torn if two threads touched it at once.
struct Block {
  std::array<std::uint64_t, 64> words{};
  static Block of(std::uint64_t n) {
    Block b;
    for (std::size_t i = 0; i < b.words.size(); ++i) b.words[i] = n + i;
    return b;
  }
  [[nodiscard]] bool whole() const {
    for (std::size_t i = 0; i < words.size(); ++i)
      if (words[i] != words[0] + i) return false;
    return true;
  }
};

template <class T>
bool push(Ring& ring, const T& value) {
  std::byte* const to = ring.draft();
  if (to == nullptr) return false;
  std::memcpy(to, &value, sizeof value);
  ring.push();
  return true;
}

template <class T>
bool take(Ring& ring, T& value) {
  const std::byte* const from = ring.front();
  if (from == nullptr) return false;
  std::memcpy(&value, from, sizeof value);
  ring.pop();
  return true;
}

TEST(Ring, GivesBackWhatWasPushedInOrderAndCountsWhatDidNotFit) {
  Ring ring(3, sizeof(int));
  EXPECT_EQ(ring.capacity(), 4u);  // the next power of two
  for (int i = 0; i < 4; ++i) EXPECT_TRUE(push(ring, i));
  EXPECT_FALSE(push(ring, 4));
  EXPECT_FALSE(push(ring, 5));
  EXPECT_EQ(ring.dropped(), 2u);
  int out = -1;
  for (int i = 0; i < 4; ++i) {
    ASSERT_TRUE(take(ring, out));
    EXPECT_EQ(out, i);
  }
  EXPECT_FALSE(take(ring, out));
  EXPECT_TRUE(push(ring, 6));  // room again
  EXPECT_EQ(ring.size(), 1u);
  EXPECT_THROW(Ring(0, 4), std::invalid_argument);
  EXPECT_THROW(Ring(4, 0), std::invalid_argument);
}

TEST(Ring, WhatWasTakenIsStillThereUntilItsPlaceIsUsedAgain) {
  Ring ring(4, sizeof(int));
  int out = 0;
  EXPECT_EQ(ring.back(0), nullptr);
  for (int i = 0; i < 6; ++i) push(ring, i), take(ring, out);
  for (int age = 0; age < 4; ++age) {
    ASSERT_NE(ring.back(static_cast<std::size_t>(age)), nullptr);
    std::memcpy(&out, ring.back(static_cast<std::size_t>(age)), sizeof out);
    EXPECT_EQ(out, 5 - age);
  }
  EXPECT_EQ(ring.back(4), nullptr);
}

TEST(Ring, BetweenTwoThreadsTakenAndDroppedMakeAll) {
  Ring ring(64, sizeof(Block));
  std::atomic<bool> over{false};
  std::thread producer([&] {
    for (std::uint64_t i = 0; i < many; ++i) push(ring, Block::of(i));
    over.store(true, std::memory_order_release);
  });
  std::uint64_t taken = 0, last = 0;
  bool rising = true, whole = true;
  Block b;
  for (;;) {
    const bool end = over.load(std::memory_order_acquire);  // before the look: what comes after it was seen
    while (take(ring, b)) {
      whole = whole && b.whole();
      rising = rising && (taken == 0 || b.words[0] > last);
      last = b.words[0];
      ++taken;
    }
    if (end) break;
  }
  producer.join();
  EXPECT_TRUE(whole);
  EXPECT_TRUE(rising);
  EXPECT_EQ(taken + ring.dropped(), many);
}

TEST(Ring, AllocatesNothingAfterItsConstruction) {
  Ring ring(8, sizeof(Block));
  const Block b = Block::of(1);
  Block out;
  palpate::test::AllocationCounter counter;
  for (int i = 0; i < 100; ++i) push(ring, b), push(ring, b), take(ring, out);
  EXPECT_EQ(counter.count(), 0u);
}

TEST(Latest, GivesTheNewestAndSaysWhetherItIsNew) {
  Latest<int> box(7);
  int out = 0;
  EXPECT_FALSE(box.read(out));
  EXPECT_EQ(out, 7);
  box.write(1);
  box.write(2);
  box.write(3);
  EXPECT_TRUE(box.read(out));
  EXPECT_EQ(out, 3);
  EXPECT_FALSE(box.read(out));
  EXPECT_EQ(out, 3);
}

TEST(Latest, BetweenTwoThreadsNothingIsTornAndNothingComesBack) {
  Latest<Block> box(Block::of(0));
  std::thread writer([&] {
    for (std::uint64_t i = 1; i <= many; ++i) box.write(Block::of(i));
  });
  std::uint64_t last = 0;
  bool whole = true, rising = true;
  Block b;
  while (last != many) {  // the last one written is read in the end, however slow anybody is
    const bool newer = box.read(b);
    whole = whole && b.whole();
    rising = rising && (newer ? b.words[0] > last : b.words[0] == last);
    last = b.words[0];
  }
  writer.join();
  EXPECT_TRUE(whole);
  EXPECT_TRUE(rising);
}

TEST(Histogram, QuantilesAreNeverTooSmallAndAtMostAThirtySecondTooLarge) {
  Histogram h;
  std::vector<std::int64_t> all;
  std::uint64_t x = 1;
  for (int i = 0; i < 5000; ++i) {
    x = x * 6364136223846793005ull + 1442695040888963407ull;
    const auto ns = static_cast<std::int64_t>((x >> 33) >> (x >> 59));
    all.push_back(ns);
    h.add(ns);
  }
  std::sort(all.begin(), all.end());
  EXPECT_EQ(h.count(), all.size());
  EXPECT_EQ(h.worst(), all.back());
  for (const double p : {0.001, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0}) {
    const auto i = static_cast<std::size_t>(std::max(1.0, std::ceil(p * static_cast<double>(all.size())))) - 1;
    EXPECT_GE(h.quantile(p), all[i]) << p;
    EXPECT_LE(static_cast<double>(h.quantile(p)), static_cast<double>(all[i]) * (1.0 + 1.0 / 32.0) + 1.0) << p;
  }
  std::uint64_t sum = 0;
  for (const auto& bin : h.bins()) sum += bin[1];
  EXPECT_EQ(sum, all.size());
}

TEST(Histogram, TakesEveryNumber) {
  Histogram h;
  EXPECT_EQ(h.quantile(0.5), 0);
  for (const std::int64_t ns : {std::int64_t{-5}, std::int64_t{0}, std::int64_t{31}, std::int64_t{32}, INT64_MAX}) h.add(ns);
  EXPECT_EQ(h.count(), 5u);
  EXPECT_EQ(h.worst(), INT64_MAX);
  EXPECT_EQ(h.quantile(0.5), 31);
}

}  // namespace
