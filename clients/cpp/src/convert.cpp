#include "convert.hpp"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>

namespace nesam::detail {

static_assert(std::numeric_limits<float>::is_iec559 && sizeof(float) == 4, "packed arrays are IEEE 754 binary32");

namespace {

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
constexpr bool little_endian = false;
#else
constexpr bool little_endian = true;
#endif

/// Turns the bytes of each value round on a big-endian machine.
void swap_if_needed(char* bytes, std::size_t values) {
  if constexpr (!little_endian) {
    for (std::size_t i = 0; i < values; ++i, bytes += 4) {
      std::swap(bytes[0], bytes[3]);
      std::swap(bytes[1], bytes[2]);
    }
  }
  (void)bytes;
  (void)values;
}

void set(v1::Vector3* message, const std::array<double, 3>& vector) {
  message->set_x(vector[0]);
  message->set_y(vector[1]);
  message->set_z(vector[2]);
}

std::array<double, 3> from_message(const v1::Vector3& message) { return {message.x(), message.y(), message.z()}; }

/// A matrix of the six soil parameters from its rows; absent where there are not 36 numbers.
template <class Numbers>
std::optional<std::array<std::array<double, 6>, 6>> matrix_from(const Numbers& numbers) {
  if (numbers.size() != 36) return std::nullopt;
  std::array<std::array<double, 6>, 6> matrix{};
  for (int i = 0; i < 36; ++i) matrix[static_cast<std::size_t>(i / 6)][static_cast<std::size_t>(i % 6)] = numbers.Get(i);
  return matrix;
}

VehicleCard from_message(const v1::VehicleCard& message) {
  VehicleCard card;
  card.name = message.name();
  const int second = static_cast<int>(message.second());
  card.second = second >= 1 && second <= 3 ? static_cast<SecondCommand>(second) : SecondCommand::unspecified;
  card.speed_min_m_s = message.speed_min_m_s();
  card.speed_max_m_s = message.speed_max_m_s();
  card.second_min = message.second_min();
  card.second_max = message.second_max();
  card.wheelbase_m = message.wheelbase_m();
  card.road_wheel_angle_max_rad = message.road_wheel_angle_max_rad();
  return card;
}

}  // namespace

Code code_from(int code) noexcept { return code >= 1 && code <= 16 ? static_cast<Code>(code) : Code::unknown; }

void pack(Span<const float> values, std::string& bytes) {
  if (values.empty()) return;
  const std::size_t before = bytes.size();
  bytes.resize(before + 4 * values.size());
  std::memcpy(&bytes[before], values.data(), 4 * values.size());
  swap_if_needed(&bytes[before], values.size());
}

std::vector<float> unpack(const std::string& bytes) {
  std::vector<float> values(bytes.size() / 4);
  if (values.empty()) return values;
  if constexpr (little_endian) {
    std::memcpy(values.data(), bytes.data(), 4 * values.size());
  } else {
    std::string copy = bytes;
    swap_if_needed(&copy[0], values.size());
    std::memcpy(values.data(), copy.data(), 4 * values.size());
  }
  return values;
}

void set(v1::VehicleState* message, const VehicleState& state) {
  set(message->mutable_position_m(), state.position_m);
  set(message->mutable_attitude_rad(), state.attitude_rad);
  set(message->mutable_velocity_m_s(), state.velocity_m_s);
  set(message->mutable_angular_velocity_rad_s(), state.angular_velocity_rad_s);
}

void set(v1::Control* message, const Control& command) {
  message->set_speed_m_s(command.speed_m_s);
  message->set_second(command.second);
}

VehicleState from_message(const v1::VehicleState& message) {
  return {from_message(message.position_m()), from_message(message.attitude_rad()), from_message(message.velocity_m_s()),
          from_message(message.angular_velocity_rad_s())};
}

SoilVector from_message(const v1::SoilVector& message) {
  return {message.k_phi(), message.k_c(), message.n(), message.c_pa(), message.phi_rad(), message.k_shear_m()};
}

SoilCorrection from_message(const v1::SoilCorrection& message) {
  SoilCorrection correction;
  const int coordinates = static_cast<int>(message.coordinates());
  correction.coordinates = coordinates == 1 || coordinates == 2 ? static_cast<SoilCoordinates>(coordinates) : SoilCoordinates::unspecified;
  correction.delta = from_message(message.delta());
  if (message.has_variance()) correction.variance = from_message(message.variance());
  const int known = std::min(static_cast<int>(correction.learned.size()), message.learned_size());
  for (int i = 0; i < known; ++i) correction.learned[static_cast<std::size_t>(i)] = message.learned(i);
  correction.covariance = matrix_from(message.covariance());
  return correction;
}

Provenance from_message(const v1::Provenance& message) {
  return {message.history_epoch(), message.soil_epoch(), message.map_id(), message.map_version(), message.map_hash(), message.bundle_name(),
          message.bundle_hash()};
}

v1::Measurement to_message(const std::string& session_id, const Measurement& measurement) {
  v1::Measurement message;
  message.set_session_id(session_id);
  message.set_sequence(measurement.sequence);
  message.set_stamp_ns(measurement.stamp_ns);
  message.set_boot_id(measurement.boot_id);
  message.set_run(measurement.run);
  set(message.mutable_state(), measurement.state);
  set(message.mutable_command(), measurement.command);
  if (measurement.wheel_speed_rad_s) {
    for (const double speed : *measurement.wheel_speed_rad_s) message.mutable_wheels()->add_speed_rad_s(speed);
  }
  if (measurement.road_wheel_angle_rad) {
    for (const double angle : *measurement.road_wheel_angle_rad) message.mutable_wheels()->add_road_wheel_angle_rad(angle);
  }
  return message;
}

v1::OpenSessionRequest to_message(const OpenOptions& options) {
  v1::OpenSessionRequest message;
  message.set_vehicle_id(options.vehicle_id);
  message.set_session_id(options.session_id);
  message.set_vehicle_card(options.vehicle_card);
  message.set_map_id(options.map_id);
  if (options.initial) *message.mutable_initial() = to_message(std::string(), *options.initial);
  return message;
}

v1::MapHeader to_header(const Map& map) {
  v1::MapHeader header;
  header.set_map_id(map.id);
  header.set_version(map.version);
  header.set_origin_x_m(map.geometry.origin_m[0]);
  header.set_origin_y_m(map.geometry.origin_m[1]);
  header.set_resolution_m(map.geometry.resolution_m);
  header.set_width(map.geometry.width);
  header.set_height(map.geometry.height);
  header.set_semantic(!map.semantic_rgb.empty());
  if (map.stamp_ns) header.set_stamp_ns(*map.stamp_ns);
  header.set_frame(map.frame);
  return header;
}

v1::MapTile to_message(const MapTile& tile) {
  v1::MapTile message;
  message.set_row(tile.row);
  message.set_column(tile.column);
  message.set_rows(tile.rows);
  message.set_columns(tile.columns);
  pack(tile.elevation_m, *message.mutable_elevation_m());
  if (!tile.semantic_rgb.empty()) message.set_semantic_rgb(tile.semantic_rgb.data(), tile.semantic_rgb.size());
  return message;
}

v1::Effect to_message(const Effect& effect) {
  v1::Effect message;
  message.set_id(effect.id);
  for (const EffectParameter& parameter : effect.parameters) {
    v1::EffectParameter& added = *message.add_parameters();
    added.set_name(parameter.name);
    added.set_value(parameter.value);
    added.set_sd(parameter.sd);
  }
  return message;
}

SessionStatus from_message(const v1::Session& message) {
  SessionStatus status;
  status.session_id = message.session_id();
  status.vehicle_id = message.vehicle_id();
  status.provenance = from_message(message.provenance());
  status.vehicle = from_message(message.vehicle());
  status.history_steps = message.history_steps();
  if (message.has_last_stamp_ns()) status.last_stamp_ns = message.last_stamp_ns();
  if (message.has_last_sequence()) status.last_sequence = message.last_sequence();
  if (message.has_state()) status.state = from_message(message.state());
  if (message.has_command()) status.command = Control{message.command().speed_m_s(), message.command().second()};
  status.soil_correction = from_message(message.soil_correction());
  if (message.has_boot_id()) status.boot_id = message.boot_id();
  if (message.has_vehicle_alive()) status.vehicle_alive = message.vehicle_alive();
  status.accepted = message.accepted();
  status.durable_place = message.durable_place();
  status.run = message.run();
  for (const v1::Effect& effect : message.effects()) status.effects.push_back(from_message(effect));
  status.effects_source = message.effects_source();
  if (message.has_alarm()) status.alarm = from_message(message.alarm());
  if (message.has_forecasts()) {
    const v1::ForecastCheck& check = message.forecasts();
    status.forecasts = ForecastCheck{check.checked(), {check.error_rms_m().begin(), check.error_rms_m().end()},
                                     {check.expected_rms_m().begin(), check.expected_rms_m().end()}, check.scale(), check.height_scale()};
  }
  return status;
}

MeasurementAnswer from_message(const v1::MeasurementAnswer& message) {
  MeasurementAnswer answer;
  answer.session_id = message.session_id();
  answer.sequence = message.sequence();
  answer.reordered = message.reordered();
  answer.stamp_ns = message.stamp_ns();
  answer.history_epoch = message.history_epoch();
  answer.soil_epoch = message.soil_epoch();
  if (message.has_soil_correction()) answer.soil_correction = from_message(message.soil_correction());
  answer.place = message.place();
  answer.durable_place = message.durable_place();
  answer.run = message.run();
  answer.map_version = message.map_version();
  answer.bundle_hash = message.bundle_hash();
  switch (message.outcome_case()) {
    case v1::MeasurementAnswer::kApplied: answer.outcome = Applied{message.applied().history_steps()}; break;
    case v1::MeasurementAnswer::kBuffered: answer.outcome = Buffered{message.buffered().next_step_in_s()}; break;
    case v1::MeasurementAnswer::kDuplicate: answer.outcome = Duplicate{}; break;
    case v1::MeasurementAnswer::kTooOld: answer.outcome = TooOld{message.too_old().behind_s()}; break;
    case v1::MeasurementAnswer::kNotFinite: answer.outcome = NotFinite{message.not_finite().field()}; break;
    case v1::MeasurementAnswer::kGated: answer.outcome = Gated{message.gated().nis()}; break;
    case v1::MeasurementAnswer::kGap: answer.outcome = Gap{message.gap().gap_s()}; break;
    case v1::MeasurementAnswer::kFuture: answer.outcome = Future{message.future().ahead_s()}; break;
    case v1::MeasurementAnswer::kClockJump: answer.outcome = ClockJump{message.clock_jump().jump_s()}; break;
    case v1::MeasurementAnswer::kRestarted: answer.outcome = Restarted{}; break;
    case v1::MeasurementAnswer::kRejected:
      answer.outcome = Rejected{code_from(message.rejected().code()), message.rejected().field(), message.rejected().message()};
      break;
    case v1::MeasurementAnswer::OUTCOME_NOT_SET: answer.outcome = Unrecognised{}; break;
  }
  return answer;
}

SoilEstimate from_message(const v1::SoilEstimate& message) {
  SoilEstimate estimate;
  estimate.session_id = message.session_id();
  estimate.soil_epoch = message.soil_epoch();
  if (message.has_stamp_ns()) estimate.stamp_ns = message.stamp_ns();
  estimate.correction = from_message(message.correction());
  estimate.history_epoch = message.history_epoch();
  estimate.map_version = message.map_version();
  estimate.bundle_hash = message.bundle_hash();
  return estimate;
}

Effect from_message(const v1::Effect& message) {
  Effect effect;
  effect.id = message.id();
  for (const v1::EffectParameter& parameter : message.parameters()) effect.parameters.push_back({parameter.name(), parameter.value(), parameter.sd()});
  return effect;
}

Alarm from_message(const v1::Alarm& message) {
  Alarm alarm;
  alarm.session_id = message.session_id();
  alarm.vehicle_id = message.vehicle_id();
  alarm.episode = message.episode();
  alarm.active = message.active();
  const int kind = static_cast<int>(message.kind());
  alarm.kind = kind >= 1 && kind <= 5 ? static_cast<AlarmKind>(kind) : AlarmKind::unspecified;
  alarm.channel = message.channel();
  alarm.size = message.size();
  alarm.statistic = message.statistic();
  alarm.threshold = message.threshold();
  alarm.stamp_ns = message.stamp_ns();
  alarm.onset_stamp_ns = message.onset_stamp_ns();
  alarm.soil_share = message.soil_share();
  alarm.description = message.description();
  alarm.diagnose = message.diagnose();
  return alarm;
}

Result<FleetSoilMap> from_message(const v1::FleetSoilMap& message) {
  FleetSoilMap map;
  map.cell_m = message.cell_m();
  for (const v1::FleetSoilCell& cell : message.cells()) {
    const auto information = matrix_from(cell.information());
    if (!information) return Error(Code::internal, "information", "a cell of the soil map does not have 6 x 6 numbers; client and server may differ in version");
    map.cells.push_back({cell.map_id(), cell.colour_rgb(), cell.column(), cell.row(), *information, from_message(cell.vector()), cell.buffers(), cell.age_s()});
  }
  return map;
}

MapDescription from_message(const v1::MapDescription& message) {
  MapDescription description;
  description.id = message.map_id();
  description.version = message.version();
  description.hash = message.hash();
  description.geometry = {{message.origin_x_m(), message.origin_y_m()}, message.resolution_m(), message.width(), message.height()};
  description.semantic = message.semantic();
  if (message.has_stamp_ns()) description.stamp_ns = message.stamp_ns();
  description.frame = message.frame();
  return description;
}

}  // namespace nesam::detail
