// FriLink: the client's end of an FRI session over UDP, with a thread that answers in time when nobody else does.
#pragma once
#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <system_error>
#include <thread>

#include "palpate/session/clock.hpp"
#include "palpate/session/fri_messages.hpp"
#include "palpate/session/realtime.hpp"

namespace palpate::fri {

/// What happened since open().
struct LinkCounts {
  std::uint64_t lost = 0;     ///< messages that never came, or were overtaken by a newer one before they were taken
  std::uint64_t refused = 0;  ///< datagrams passed over: old, doubled, damaged, of another kind or sender
  std::uint64_t late = 0;     ///< messages that nobody answered by the deadline, or only after a period
};

/// A controller sends a monitoring message per period and expects an answer that reflects its sequence number in the
/// same period. Each message that wants one is answered at most once, with a command that was made for this very message,
/// or with the safe one: the interpolated position, no torque, no wrench. With a deadline, the thread that
/// receives sends the safe answer when it has passed and no command has come; while expect(false), at once.
///
/// One thread calls receive(), answer(), expect().
class Link {
 public:
  /// joints: of the robot. period, deadline [ns]; deadline 0: never answered by itself.
  Link(int joints, std::int64_t period, std::int64_t deadline) : n_(joints), period_(period), deadline_(deadline) {}
  Link(const Link&) = delete;
  Link& operator=(const Link&) = delete;
  ~Link() { close(); }

  /// Listens. address: of this computer's interface; controller: whose messages count, empty: those of the first sender of one.
  /// Throws std::system_error.
  void open(const std::string& address, std::uint16_t port, const std::string& controller) {
    close();
    expected_.reset();
    if (!controller.empty()) expected_ = parse(controller);
    sockaddr_in own{};
    own.sin_family = AF_INET;
    own.sin_port = htons(port);
    own.sin_addr = parse(address);
    fd_ = ::socket(AF_INET, SOCK_DGRAM, 0);
    if (fd_ < 0 || ::bind(fd_, reinterpret_cast<const sockaddr*>(&own), sizeof own) != 0) {
      const int error = errno;
      close();
      throw std::system_error(error, std::generic_category());
    }
    newest_ = {};
    counts_ = {};
    stamp_ = -1;
    fresh_ = due_ = expecting_ = known_ = false;
    unanswered_ = 0;
    sequence_ = 0;
    over_ = false;
    thread_ = std::thread([this] { run(); });
  }

  void close() noexcept {
    over_ = true;
    if (thread_.joinable()) thread_.join();
    if (fd_ >= 0) ::close(fd_);
    fd_ = -1;
  }

  /// The newest message that was not taken yet; waits for one, at most `timeout` [ns]. arrived: when, CLOCK_MONOTONIC [ns].
  bool receive(Monitoring& out, std::int64_t& arrived, std::int64_t timeout) {
    std::unique_lock lock(mutex_);
    if (!came_.wait_for(lock, std::chrono::nanoseconds(std::max<std::int64_t>(timeout, 0)), [this] { return fresh_; })) return false;
    fresh_ = false;
    out = taken_ = newest_;
    arrived = arrived_;
    return true;
  }

  /// Answers the message that was taken last, unless it was answered, is overtaken or wants none; spans empty: the safe answer.
  /// False: nothing was sent. Throws std::system_error if it cannot be.
  bool answer(std::span<const double> position = {}, std::span<const double> torque = {}, std::span<const double> wrench = {}) {
    const std::lock_guard lock(mutex_);
    if (!due_ || newest_.time_ns() != taken_.time_ns()) return false;
    if (const int error = send(position, torque, wrench); error != 0) throw std::system_error(error, std::generic_category());
    return true;
  }
  /// Whether the message that was taken last waits for an answer.
  [[nodiscard]] bool due() {
    const std::lock_guard lock(mutex_);
    return due_ && newest_.time_ns() == taken_.time_ns();
  }
  /// Whether commands are to be waited for; false at first. Without a deadline it changes nothing.
  void expect(bool commands) {
    const std::lock_guard lock(mutex_);
    expecting_ = commands;
  }
  [[nodiscard]] LinkCounts counts() {
    const std::lock_guard lock(mutex_);
    return counts_;
  }
  /// Address of the controller; empty: none has sent yet.
  [[nodiscard]] std::string peer() {
    const std::lock_guard lock(mutex_);
    char text[INET_ADDRSTRLEN] = "";
    if (known_) inet_ntop(AF_INET, &peer_.sin_addr, text, sizeof text);
    return text;
  }

 private:
  static in_addr parse(const std::string& address) {
    in_addr out{};
    if (inet_pton(AF_INET, address.c_str(), &out) != 1) throw std::system_error(EINVAL, std::generic_category(), address + " is no IPv4 address");
    return out;
  }

  void run() noexcept {
    try {
      enter_realtime({.priority = 80, .lock_memory = false});  // what is refused costs punctuality, nothing else
    } catch (...) {  // no memory for the words of the refusal
    }
    std::array<std::uint8_t, max_bytes + 1> data;
    while (!over_) {
      pollfd waiting{fd_, POLLIN, 0};
      const std::int64_t wait = patience();
      const timespec time{static_cast<time_t>(wait / 1'000'000'000), static_cast<long>(wait % 1'000'000'000)};
      if (::ppoll(&waiting, 1, &time, nullptr) > 0) {
        sockaddr_in sender{};
        socklen_t size = sizeof sender;
        const ssize_t got = ::recvfrom(fd_, data.data(), data.size(), MSG_DONTWAIT, reinterpret_cast<sockaddr*>(&sender), &size);
        // an error is an answer that met a closed port: the controller's side is gone for now, the silence will tell
        if (got >= 0) take({data.data(), static_cast<std::size_t>(got)}, sender);
      }
      punctual();
    }
  }

  /// How long the thread may sleep [ns].
  std::int64_t patience() {
    const std::lock_guard lock(mutex_);
    constexpr std::int64_t longest = 20'000'000;  // to see over_
    if (deadline_ == 0 || !due_) return longest;
    return std::clamp<std::int64_t>(arrived_ + deadline_ - clock_.now(), 0, longest);
  }

  /// The safe answer, where it is time for it.
  void punctual() {
    const std::lock_guard lock(mutex_);
    if (deadline_ == 0 || !due_) return;
    if (expecting_ && clock_.now() < arrived_ + deadline_) return;
    counts_.late += expecting_;
    send({}, {}, {});  // a failure shows in the next answer()
  }

  void take(std::span<const std::uint8_t> data, const sockaddr_in& sender) {
    Monitoring message;
    const bool good = data.size() <= max_bytes && decode(data, message) && usable(message, n_);
    const std::lock_guard lock(mutex_);
    const in_addr* from = known_ ? &peer_.sin_addr : expected_ ? &*expected_ : nullptr;
    // newer by time, not by sequence, which starts again with a new session
    if (!good || (from != nullptr && from->s_addr != sender.sin_addr.s_addr) || message.time_ns() <= stamp_) {
      ++counts_.refused;
      return;
    }
    if (known_) {
      const std::uint32_t gap = message.sequence - newest_.sequence;
      if (gap > 0 && gap < 1000) counts_.lost += gap - 1;
    }
    counts_.lost += fresh_;  // nobody will see the one before
    newest_ = message;
    stamp_ = message.time_ns();
    peer_ = sender;
    known_ = fresh_ = true;
    arrived_ = clock_.now();
    ++unanswered_;
    due_ = unanswered_ >= std::max<std::uint32_t>(1, message.receive_multiplier);
    came_.notify_all();
  }

  /// Answers the newest message; the errno, or 0. Needs the mutex.
  int send(std::span<const double> position, std::span<const double> torque, std::span<const double> wrench) noexcept {
    constexpr std::array<double, max_joints> zeros{};
    Answer answer{sequence_++, newest_.sequence, {}, {}, {}};
    const auto n = static_cast<std::size_t>(n_);
    if (newest_.session_state >= commanding_wait) {
      answer.position = position.empty() ? std::span<const double>(newest_.interpolated.value.data(), n) : position;
      if (newest_.command_mode == mode_torque) answer.torque = torque.empty() ? std::span<const double>(zeros.data(), n) : torque;
      if (newest_.command_mode == mode_wrench) answer.wrench = wrench.empty() ? std::span<const double>(zeros.data(), 6) : wrench;
    }
    std::array<std::uint8_t, max_bytes> data;
    const std::size_t size = encode(answer, data);
    if (clock_.now() - arrived_ > period_) ++counts_.late;
    due_ = false;
    unanswered_ = 0;
    const ssize_t sent = ::sendto(fd_, data.data(), size, MSG_DONTWAIT, reinterpret_cast<const sockaddr*>(&peer_), sizeof peer_);
    return sent < 0 && errno != ECONNREFUSED ? errno : 0;
  }

  int n_;
  std::int64_t period_, deadline_;
  int fd_ = -1;
  std::thread thread_;
  std::atomic<bool> over_{false};
  MonotonicClock clock_;

  std::mutex mutex_;  // held for microseconds; everything below is its
  std::condition_variable came_;
  std::optional<in_addr> expected_;
  sockaddr_in peer_{};
  Monitoring newest_{}, taken_{};
  LinkCounts counts_{};
  std::int64_t stamp_ = -1, arrived_ = 0;
  std::uint32_t unanswered_ = 0, sequence_ = 0;
  bool fresh_ = false, due_ = false, expecting_ = false, known_ = false;
};

}  // namespace palpate::fri
