// FRI's wire format: what is written fits, what is read is checked, no bytes do harm. Beside protobuf's own: test_drivers_fri.py.
#include <gtest/gtest.h>

#include <array>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "no_alloc.hpp"
#include "palpate/session/fri_link.hpp"

using namespace palpate;
using namespace palpate::fri;

namespace {

std::vector<std::uint8_t> block(std::uint8_t field, const std::vector<std::uint8_t>& inner) {
  std::vector<std::uint8_t> out{static_cast<std::uint8_t>(field << 3 | 2), static_cast<std::uint8_t>(inner.size())};
  for (const std::uint8_t byte : inner) out.push_back(byte);
  return out;
}
void append(std::vector<std::uint8_t>& to, const std::vector<std::uint8_t>& more) {
  for (const std::uint8_t byte : more) to.push_back(byte);
}
std::vector<std::uint8_t> doubles(int n, double value) {
  std::vector<std::uint8_t> out;
  for (int i = 0; i < n; ++i) {
    out.push_back(9);
    const auto bits = std::bit_cast<std::uint64_t>(value);
    for (int k = 0; k < 8; ++k) out.push_back(static_cast<std::uint8_t>(bits >> (8 * k)));
  }
  return out;
}
/// A message of a robot with two joints.
std::vector<std::uint8_t> message(double position = 0.5, int joints = 2) {
  std::vector<std::uint8_t> out = block(1, {0x0d, 0x42, 0x51, 0x24, 0x00, 0x10, 0x07});
  std::vector<std::uint8_t> monitor = block(1, doubles(joints, position));
  append(monitor, block(2, doubles(joints, 1.0)));
  append(monitor, block(15, {0x08, 0x01, 0x10, 0x02}));
  append(out, block(3, monitor));
  append(out, block(4, {0x08, 0x02, 0x18, 0x05}));
  return out;
}

TEST(FriMessages, AMessageIsReadAndJudged) {
  Monitoring m;
  ASSERT_TRUE(decode(message(), m));
  EXPECT_EQ(m.sequence, 7u);
  EXPECT_EQ(m.time_ns(), 1'000'000'002);
  EXPECT_EQ(m.position.value[1], 0.5);
  EXPECT_EQ(m.send_period, 5u);
  EXPECT_TRUE(usable(m, 2));
  EXPECT_FALSE(usable(m, 3));
  ASSERT_TRUE(decode(message(std::numeric_limits<double>::quiet_NaN()), m));
  EXPECT_FALSE(usable(m, 2));
}

TEST(FriMessages, MoreNumbersThanAnyRobotHasAreCountedNotKept) {
  Monitoring m;
  std::vector<std::uint8_t> many = doubles(60, 1.0);
  std::vector<std::uint8_t> monitor{0x0a, 0x9c, 0x04};  // 540 bytes
  append(monitor, many);
  std::vector<std::uint8_t> data{0x1a, 0x9f, 0x04};
  append(data, monitor);
  ASSERT_TRUE(decode(data, m));
  EXPECT_EQ(m.position.count, 60);
  EXPECT_FALSE(m.position.are(16));
}

TEST(FriMessages, EveryCutAndEveryChangedByteIsReadOrRefused) {
  const std::vector<std::uint8_t> good = message();
  Monitoring m;
  palpate::test::AllocationCounter counter;
  std::size_t refused = 0;
  for (std::size_t i = 0; i < good.size(); ++i) refused += !decode(std::span(good).first(i), m);
  std::array<std::uint8_t, 256> bad;
  std::copy(good.begin(), good.end(), bad.begin());
  for (std::size_t i = 0; i < good.size(); ++i)
    for (int byte = 0; byte < 256; ++byte) {
      bad[i] = static_cast<std::uint8_t>(byte);
      refused += !decode(std::span(bad).first(good.size()), m);
      bad[i] = good[i];
    }
  EXPECT_GT(refused, 1000u);
  EXPECT_EQ(counter.count(), 0u);
}

TEST(FriMessages, TheLongestAnswerFits) {
  std::array<double, 16> joints;
  joints.fill(-1.0);
  std::array<std::uint8_t, max_bytes> out;
  const std::size_t size = encode({0xFFFFFFFF, 0xFFFFFFFF, joints, joints, std::span<const double>(joints).first(6)}, out);
  EXPECT_GT(size, 9u * 38u);
  EXPECT_LT(size, max_bytes);
}

TEST(FriLink, SaysWhyItCannotListen) {
  Link link(2, 5'000'000, 0);
  EXPECT_THROW(link.open("not an address", 30200, ""), std::system_error);
  EXPECT_THROW(link.open("127.0.0.1", 30200, "nor this"), std::system_error);
  link.close();
  link.close();
}

TEST(FriLink, AnswersOnceWithWhatItIsToldOrSafelyByItself) {
  for (const bool by_itself : {false, true}) {
    Link link(2, 5'000'000, by_itself ? 1'000'000 : 0);
    constexpr std::uint16_t port = 30209;
    link.open("127.0.0.61", port, "");
    const int peer = ::socket(AF_INET, SOCK_DGRAM, 0);
    ASSERT_GE(peer, 0);
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_port = htons(port);
    ASSERT_EQ(inet_pton(AF_INET, "127.0.0.61", &to.sin_addr), 1);
    const std::vector<std::uint8_t> data = message();
    ASSERT_EQ(::sendto(peer, data.data(), data.size(), 0, reinterpret_cast<const sockaddr*>(&to), sizeof to), static_cast<ssize_t>(data.size()));
    Monitoring m;
    std::int64_t arrived = 0;
    while (!link.receive(m, arrived, 100'000'000)) {
    }
    EXPECT_EQ(m.sequence, 7u);
    if (!by_itself) EXPECT_TRUE(link.answer());
    std::array<std::uint8_t, max_bytes> got;
    EXPECT_GT(::recv(peer, got.data(), got.size(), 0), 0);  // waits until it comes
    EXPECT_FALSE(link.answer());
    EXPECT_FALSE(link.due());
    EXPECT_EQ(link.peer(), "127.0.0.1");
    ::close(peer);
  }
}

}  // namespace
