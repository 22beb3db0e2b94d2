#pragma once

#include <array>
#include <cstddef>
#include <utility>
#include <vector>

#include <nesam/span.hpp>

namespace nesam {

/// Numbers of any shape, row-major, that belong to this object; empty, with all sides 0, when there are none. Indexing is not checked.
template <class T, std::size_t Rank>
class Array {
 public:
  Array() = default;
  Array(std::vector<T> values, const std::array<std::size_t, Rank>& shape) : values_(std::move(values)), shape_(shape) {}

  bool empty() const noexcept { return values_.empty(); }
  const std::array<std::size_t, Rank>& shape() const noexcept { return shape_; }
  /// Valid as long as this object is neither changed nor moved from.
  View<const T, Rank> view() const noexcept { return {values_, shape_}; }
  Span<const T> values() const noexcept { return values_; }
  /// One value.
  template <class... Indices>
  const T& operator()(Indices... indices) const noexcept {
    return view()(indices...);
  }
  /// The values under the first indices, as `View::part`.
  template <class... Indices>
  Span<const T> part(Indices... indices) const noexcept {
    return view().part(indices...);
  }

 private:
  std::vector<T> values_;
  std::array<std::size_t, Rank> shape_{};
};

}  // namespace nesam
