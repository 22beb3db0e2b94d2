#include <nesam/prediction.hpp>

namespace nesam {

namespace {

std::size_t bits_set(std::uint32_t word) noexcept {
  std::size_t count = 0;
  for (; word != 0; word &= word - 1) ++count;
  return count;
}

}  // namespace

std::size_t Prediction::channel_count() const noexcept { return bits_set(channels); }

std::optional<std::size_t> Prediction::column(Channel channel) const noexcept {
  if ((channels & bit(channel)) == 0) return std::nullopt;
  return bits_set(channels & (bit(channel) - 1));
}

}  // namespace nesam
