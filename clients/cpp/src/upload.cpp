#include <algorithm>

#include "convert.hpp"
#include "core.hpp"

namespace nesam::detail {

namespace {

/// Size of one tile message, bytes: well below the server's limit, large enough to be quick.
constexpr std::size_t tile_bytes = std::size_t{1} << 20;

/// The rectangle of a map as message.
v1::UploadMapRequest tile_message(const Map& map, std::size_t row, std::size_t column, std::size_t rows, std::size_t columns) {
  v1::UploadMapRequest message;
  v1::MapTile& tile = *message.mutable_tile();
  tile.set_row(static_cast<std::uint32_t>(row));
  tile.set_column(static_cast<std::uint32_t>(column));
  tile.set_rows(static_cast<std::uint32_t>(rows));
  tile.set_columns(static_cast<std::uint32_t>(columns));
  for (std::size_t r = row; r < row + rows; ++r) {
    const std::size_t first = r * map.geometry.width + column;
    pack(map.elevation_m.subspan(first, columns), *tile.mutable_elevation_m());
    if (!map.semantic_rgb.empty()) {
      tile.mutable_semantic_rgb()->append(reinterpret_cast<const char*>(map.semantic_rgb.data() + 3 * first), 3 * columns);
    }
  }
  return message;
}

/// INVALID_ARGUMENT when layers do not have the shape that they say; `shape` names it.
Result<void> check_layers(Span<const float> elevation_m, Span<const std::uint8_t> semantic_rgb, std::size_t pixels, const char* shape) {
  const auto fault = [shape](const char* field, std::size_t size, std::size_t needed) {
    const std::string reason = " values, " + std::string(shape) + " needs " + std::to_string(needed);
    return Error(Code::invalid_argument, field, "`" + std::string(field) + "`: has " + std::to_string(size) + reason);
  };
  if (elevation_m.size() != pixels) return fault("elevation_m", elevation_m.size(), pixels);
  if (!semantic_rgb.empty() && semantic_rgb.size() != 3 * pixels) return fault("semantic_rgb", semantic_rgb.size(), 3 * pixels);
  return {};
}

/// Sends header and tiles. False: the server has ended the call; its status says why.
bool write_all(grpc::ClientWriter<v1::UploadMapRequest>& writer, const Map& map) {
  v1::UploadMapRequest first;
  *first.mutable_header() = to_header(map);
  if (!writer.Write(first)) return false;
  const std::size_t width = map.geometry.width;
  const std::size_t height = map.geometry.height;
  const std::size_t pixels = tile_bytes / (map.semantic_rgb.empty() ? 4 : 7);
  const std::size_t columns_max = std::max<std::size_t>(1, std::min(width, pixels));
  const std::size_t rows_max = std::max<std::size_t>(1, pixels / columns_max);
  for (std::size_t row = 0; row < height; row += rows_max) {
    for (std::size_t column = 0; column < width; column += columns_max) {
      const std::size_t rows = std::min(rows_max, height - row);
      const std::size_t columns = std::min(columns_max, width - column);
      if (!writer.Write(tile_message(map, row, column, rows, columns))) return false;
    }
  }
  return writer.WritesDone();
}

}  // namespace

Result<MapDescription> Core::upload(const Map& map, Timeout timeout) const {
  const std::size_t pixels = std::size_t{map.geometry.width} * map.geometry.height;
  if (auto layers = check_layers(map.elevation_m, map.semantic_rgb, pixels, "height x width"); !layers) return layers.error();
  grpc::ClientContext context;
  introduce(context);
  context.set_deadline(deadline(timeout.value_or(options.upload_timeout)));
  v1::MapDescription reply;
  const auto writer = terrain->UploadMap(&context, &reply);
  write_all(*writer, map);
  const grpc::Status status = writer->Finish();
  if (!status.ok()) return error_from(status, context);
  return from_message(reply);
}

Result<MapDescription> Core::patch(const std::string& map_id, std::uint64_t base_version, const MapTile& tile, Timeout timeout) const {
  const std::size_t pixels = std::size_t{tile.rows} * tile.columns;
  if (auto layers = check_layers(tile.elevation_m, tile.semantic_rgb, pixels, "rows x columns"); !layers) return layers.error();
  v1::PatchTileRequest request;
  request.set_map_id(map_id);
  request.set_base_version(base_version);
  *request.mutable_tile() = to_message(tile);
  auto reply = call(*terrain, &v1::Terrain::Stub::PatchTile, request, timeout);
  if (!reply) return reply.error();
  return from_message(*reply);
}

}  // namespace nesam::detail
