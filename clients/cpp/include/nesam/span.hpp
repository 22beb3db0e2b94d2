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

/// A row-major view of any shape, without padding: the last index moves fastest.
///
/// Indexing is not checked; `fits()` says whether storage and shape agree.
template <class T, std::size_t Rank>
class View {
 public:
  constexpr View() noexcept = default;
  constexpr View(Span<T> values, const std::array<std::size_t, Rank>& shape) noexcept : values_(values), shape_(shape) {}
  /// A view for reading of a view for writing.
  template <class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  constexpr View(View<std::remove_cv_t<T>, Rank> other) noexcept : values_(other.values()), shape_(other.shape()) {}

  constexpr const std::array<std::size_t, Rank>& shape() const noexcept { return shape_; }
  constexpr Span<T> values() const noexcept { return values_; }
  constexpr bool empty() const noexcept { return values_.empty(); }
  /// Whether the storage holds exactly as many values as the shape has places.
  constexpr bool fits() const noexcept {
    // Division instead of a product that could overflow.
    std::size_t rest = values_.size();
    for (const std::size_t side : shape_) {
      if (side == 0) return values_.empty();
      if (rest % side != 0) return false;
      rest /= side;
    }
    return rest == 1;
  }
  /// One value.
  template <class... Indices>
  constexpr T& operator()(Indices... indices) const noexcept {
    static_assert(sizeof...(Indices) == Rank, "one index for each dimension");
    return values_[block(indices...)];
  }
  /// The values under the first indices, for example the 12 x 12 matrix of one step of a (samples, steps, 12, 12) view.
  template <class... Indices>
  constexpr Span<T> part(Indices... indices) const noexcept {
    static_assert(sizeof...(Indices) <= Rank, "not more indices than dimensions");
    std::size_t size = 1;
    for (std::size_t axis = sizeof...(Indices); axis < Rank; ++axis) size *= shape_[axis];
    return values_.subspan(block(indices...) * size, size);
  }

 private:
  /// Place of the block under the first indices among all blocks of its size.
  template <class... Indices>
  constexpr std::size_t block(Indices... indices) const noexcept {
    std::size_t place = 0, axis = 0;
    ((place = place * shape_[axis++] + static_cast<std::size_t>(indices)), ...);
    return place;
  }

  Span<T> values_;
  std::array<std::size_t, Rank> shape_{};
};

/// A row-major view of shape (samples, steps, channels): value (n, k, c) lies at `(n * steps + k) * channels + c`.
///
/// Controls have the shape (N, K, 2), predicted states (N, steps, C).
template <class T>
class View3 : public View<T, 3> {
 public:
  constexpr View3() noexcept = default;
  constexpr View3(Span<T> values, std::size_t samples, std::size_t steps, std::size_t channels) noexcept
      : View<T, 3>(values, {samples, steps, channels}) {}
  /// A view for reading of a view for writing.
  template <class U = T, class = std::enable_if_t<std::is_const_v<U>>>
  constexpr View3(View3<std::remove_cv_t<T>> other) noexcept : View<T, 3>(other) {}

  constexpr std::size_t samples() const noexcept { return this->shape()[0]; }
  constexpr std::size_t steps() const noexcept { return this->shape()[1]; }
  constexpr std::size_t channels() const noexcept { return this->shape()[2]; }
  /// The steps of one sample, shape (steps, channels).
  constexpr Span<T> sample(std::size_t n) const noexcept { return this->part(n); }
  /// The channels of one step of one sample.
  constexpr Span<T> step(std::size_t n, std::size_t k) const noexcept { return this->part(n, k); }
};

}  // namespace nesam
