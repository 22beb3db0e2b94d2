#pragma once

#include <array>
#include <cstddef>
#include <type_traits>
#include <vector>

namespace nesam {

/// A view of `size()` consecutive values that belong to somebody else. C++17 has no `std::span`; this is the part of it that the client needs.
///
/// The view is valid as long as the storage behind it. Indexing is not checked.
template <class T>
class Span {
 public:
  using value_type = std::remove_cv_t<T>;

  constexpr Span() noexcept = default;
  constexpr Span(T* data, std::size_t size) noexcept : data_(data), size_(size) {}
  template <std::size_t N>
  constexpr Span(T (&values)[N]) noexcept : data_(values), size_(N) {}
  template <std::size_t N>
  constexpr Span(std::array<value_type, N>& values) noexcept : data_(values.data()), size_(N) {}
  template <std::size_t N, class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  constexpr Span(const std::array<value_type, N>& values) noexcept : data_(values.data()), size_(N) {}
  Span(std::vector<value_type>& values) noexcept : data_(values.data()), size_(values.size()) {}
  template <class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  Span(const std::vector<value_type>& values) noexcept : data_(values.data()), size_(values.size()) {}
  /// A view for reading of a view for writing.
  template <class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  constexpr Span(Span<value_type> other) noexcept : data_(other.data()), size_(other.size()) {}

  constexpr T* data() const noexcept { return data_; }
  constexpr std::size_t size() const noexcept { return size_; }
  constexpr bool empty() const noexcept { return size_ == 0; }
  constexpr T* begin() const noexcept { return data_; }
  constexpr T* end() const noexcept { return data_ + size_; }
  constexpr T& operator[](std::size_t i) const noexcept { return data_[i]; }
  constexpr Span subspan(std::size_t first, std::size_t count) const noexcept { return {data_ + first, count}; }

 private:
  T* data_ = nullptr;
  std::size_t size_ = 0;
};

/// A row-major view of shape (samples, steps, channels), without padding: value (n, k, c) lies at `(n * steps + k) * channels + c`.
///
/// Controls have the shape (N, K, 2), predicted states (N, steps, C). Indexing is not checked; `fits()` says whether storage and shape agree.
template <class T>
class View3 {
 public:
  constexpr View3() noexcept = default;
  constexpr View3(Span<T> values, std::size_t samples, std::size_t steps, std::size_t channels) noexcept
      : values_(values), samples_(samples), steps_(steps), channels_(channels) {}
  /// A view for reading of a view for writing.
  template <class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  constexpr View3(View3<std::remove_cv_t<T>> other) noexcept
      : values_(other.values()), samples_(other.samples()), steps_(other.steps()), channels_(other.channels()) {}

  constexpr std::size_t samples() const noexcept { return samples_; }
  constexpr std::size_t steps() const noexcept { return steps_; }
  constexpr std::size_t channels() const noexcept { return channels_; }
  constexpr Span<T> values() const noexcept { return values_; }
  /// Whether the storage holds exactly samples x steps x channels values.
  constexpr bool fits() const noexcept {
    // Division instead of a product that could overflow.
    std::size_t rest = values_.size();
    for (const std::size_t side : {samples_, steps_, channels_}) {
      if (side == 0) return values_.empty();
      if (rest % side != 0) return false;
      rest /= side;
    }
    return rest == 1;
  }
  constexpr T& operator()(std::size_t n, std::size_t k, std::size_t c) const noexcept { return values_[(n * steps_ + k) * channels_ + c]; }
  /// The steps of one sample, shape (steps, channels).
  constexpr Span<T> sample(std::size_t n) const noexcept { return values_.subspan(n * steps_ * channels_, steps_ * channels_); }
  /// The channels of one step of one sample.
  constexpr Span<T> step(std::size_t n, std::size_t k) const noexcept { return values_.subspan((n * steps_ + k) * channels_, channels_); }

 private:
  Span<T> values_;
  std::size_t samples_ = 0;
  std::size_t steps_ = 0;
  std::size_t channels_ = 0;
};

}  // namespace nesam
