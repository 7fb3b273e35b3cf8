// Counts heap allocations of the calling thread, to prove that a step() makes none.
//
// On glibc malloc itself is counted (malloc, calloc, realloc, aligned_alloc, posix_memalign), and with it operator new,
// std::function, std::string and thrown exceptions. Elsewhere, and under the sanitizers, which own malloc, operator new is.
// no_alloc.cpp is linked into every test executable; including this header is all a test does:
//
//   palpate::test::AllocationCounter counter;
//   observer.step(sample, out);
//   EXPECT_EQ(counter.count(), 0u);
#pragma once
#include <cstddef>

namespace palpate::test {

/// Heap allocations of this thread since it started.
std::size_t allocations() noexcept;

/// Heap allocations of this thread since the counter was made.
class AllocationCounter {
 public:
  AllocationCounter() noexcept : start_(allocations()) {}
  std::size_t count() const noexcept { return allocations() - start_; }

 private:
  std::size_t start_;
};

}  // namespace palpate::test
