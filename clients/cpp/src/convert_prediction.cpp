#include "convert_prediction.hpp"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>

#include "convert.hpp"
#include "half.hpp"

namespace nesam::detail {

namespace {

/// Entries of a state.
constexpr std::size_t state_size = 12;
/// Parameters of the soil.
constexpr std::size_t soil_size = 6;
/// Sigma points of the soil: the estimate and two for each parameter.
constexpr std::size_t sigma_points = 2 * soil_size + 1;

std::size_t soil_groups_of(const Extras& extras) {
  if (extras.soil_sigma_points) return sigma_points;
  return std::max<std::size_t>(1, extras.soil_deltas.size() / soil_size);
}

/// What is wrong with the shape of the controls, before anything is copied.
std::string shape_fault(const View3<const float>& controls) {
  if (controls.channels() != 2) return "has " + std::to_string(controls.channels()) + " channels, 2 are needed";
  if (!controls.fits()) {
    return "has " + std::to_string(controls.values().size()) + " numbers, which is not samples x steps x 2 = " + std::to_string(controls.samples()) + " x " +
           std::to_string(controls.steps()) + " x 2";
  }
  constexpr std::size_t largest = std::numeric_limits<std::uint32_t>::max();
  if (controls.samples() > largest || controls.steps() > largest) return "has more than 2^32 - 1 samples or steps";
  return {};
}

std::optional<Error> fault_of(const PredictRequest& request) {
  if (!request.drawing) {
    std::string fault = shape_fault(request.controls);
    if (fault.empty()) return std::nullopt;
    return Error(Code::invalid_argument, "controls", "`controls`: " + fault);
  }
  if (!request.controls.empty()) return Error(Code::invalid_argument, "controls", "`controls`: must be empty when the service draws the candidates");
  if (request.drawing->nominal.size() % 2 != 0) return Error(Code::invalid_argument, "drawing.nominal", "`drawing.nominal`: two numbers for each step");
  return std::nullopt;
}

void set(v1::CandidateDrawing* message, const CandidateDrawing& drawing) {
  pack(drawing.nominal, *message->mutable_nominal());
  message->set_speed_sd_m_s(drawing.speed_sd_m_s);
  message->set_second_sd(drawing.second_sd);
  message->set_correlation(drawing.correlation);
  message->set_seed(drawing.seed);
}

void set(v1::PathCost* message, const PathCost& cost) {
  pack(cost.path_m, *message->mutable_path());
  message->set_speed_m_s(cost.speed_m_s);
  message->set_path_weight(cost.path_weight);
  message->set_speed_weight(cost.speed_weight);
  message->set_tilt_weight(cost.tilt_weight);
  message->set_speed_change_weight(cost.speed_change_weight);
  message->set_second_change_weight(cost.second_change_weight);
  message->set_best(cost.best);
  message->set_temperature(cost.temperature);
}

void set(v1::PredictExtras* message, const Extras& extras) {
  message->set_jacobians(extras.jacobians);
  message->set_covariance(extras.covariance);
  pack(extras.start_covariance, *message->mutable_start_covariance());
  message->set_risk(extras.risk);
  pack(extras.soil_deltas, *message->mutable_soil_deltas());
  message->set_soil_sigma_points(extras.soil_sigma_points);
  message->set_exact_terrain(extras.exact_terrain);
  message->set_interpolation_deviation(extras.interpolation_deviation);
}

Error misfit(const char* field) {
  return Error(Code::internal, field, "the reply does not have the shape that was asked for; client and server may differ in version");
}

bool is_half(const v1::PredictReply& message) { return message.precision() == v1::PRECISION_F16; }

/// The states of a reply that has the shape asked for. Positions of 16-bit ones are offsets from the start.
std::vector<float> states_from(const v1::PredictReply& message, const Prediction& prediction) {
  if (!is_half(message)) return unpack(message.states());
  std::vector<float> states = unpack_half(message.states());
  std::array<double, state_size> offsets{};
  std::size_t channels = 0;
  for (std::size_t channel = 0; channel < state_size; ++channel) {
    if ((prediction.channels >> channel & 1) == 0) continue;
    offsets[channels++] = channel < prediction.start.position_m.size() ? prediction.start.position_m[channel] : 0.0;
  }
  for (std::size_t i = 0; i < states.size(); ++i) states[i] = static_cast<float>(states[i] + offsets[i % channels]);
  return states;
}

/// Whether number of candidates and sizes of the arrays are as asked for.
bool fits(const v1::PredictReply& message, const Prediction& prediction, const Asked& asked) {
  const std::size_t samples = prediction.samples;
  const std::size_t points = prediction.rows() * prediction.steps;
  const std::size_t width = is_half(message) ? 2 : 4;
  const std::size_t drawn = asked.drawn ? prediction.candidates() * asked.horizon : 0;
  const bool fewer = asked.samples_min > 0 && samples >= asked.samples_min && samples < asked.samples;
  return (samples == asked.samples || fewer) && prediction.soil_groups == asked.soil_groups && message.costs().size() == (asked.ranked ? 4 * samples : 0) &&
         message.states().size() == width * points * prediction.channel_count() &&
         message.sinkage_m().size() == (asked.wheel_sinkage ? 4 * width * points : 0) && (asked.half || width == 4) &&
         message.drawn_controls().size() == 8 * drawn && static_cast<std::size_t>(message.validity_size()) == prediction.rows();
}

/// Unpacks one of the extra outputs. False: it does not have the shape, or is there without being asked for.
template <std::size_t Rank>
bool take(const std::string& bytes, bool wanted, const std::array<std::size_t, Rank>& shape, Array<float, Rank>& array) {
  if (!wanted) return bytes.empty();
  array = {unpack(bytes), shape};
  return array.view().fits();
}

Result<ExtraOutputs> extra_outputs(const v1::PredictReply& message, const Prediction& prediction, const Asked& asked) {
  const std::size_t samples = prediction.samples, rows = prediction.rows(), steps = prediction.steps;
  ExtraOutputs extras;
  if (!take(message.jacobian_start(), asked.jacobians, {samples, steps, state_size, state_size}, extras.jacobian_start)) return misfit("jacobian_start");
  if (!take(message.jacobian_controls(), asked.jacobians, {samples, steps, state_size, asked.horizon, 2}, extras.jacobian_controls)) {
    return misfit("jacobian_controls");
  }
  if (!take(message.jacobian_soil(), asked.jacobians, {samples, steps, state_size, soil_size}, extras.jacobian_soil)) return misfit("jacobian_soil");
  if (!take(message.covariance(), asked.covariance, {samples, steps, state_size, state_size}, extras.covariance)) return misfit("covariance");
  if (!take(message.wheel_load_n(), asked.risk, {rows, steps, 4}, extras.wheel_load_n)) return misfit("wheel_load_n");
  if (!take(message.wheel_slip(), asked.risk, {rows, steps, 4}, extras.wheel_slip)) return misfit("wheel_slip");
  if (!take(message.load_transfer_ratio(), asked.risk, {rows, steps}, extras.load_transfer_ratio)) return misfit("load_transfer_ratio");
  if (!take(message.traction_reserve(), asked.risk, {rows, steps}, extras.traction_reserve)) return misfit("traction_reserve");
  if (asked.covariance) {
    std::array<double, 6> single{};
    if (message.region_90_single_size() != static_cast<int>(single.size())) return misfit("region_90_single");
    std::copy(message.region_90_single().begin(), message.region_90_single().end(), single.begin());
    extras.region_90_planar = message.region_90_planar();
    extras.region_90_single = single;
  }
  if (message.has_interpolation_deviation_m()) extras.interpolation_deviation_m = message.interpolation_deviation_m();
  return extras;
}

}  // namespace

Asked::Asked(const PredictRequest& request)
    : samples(request.drawing ? request.drawing->samples : request.controls.samples()),
      samples_min(request.samples_min),
      horizon(request.drawing ? request.drawing->nominal.size() / 2 : request.controls.steps()),
      soil_groups(soil_groups_of(request.extras)),
      drawn(request.drawing.has_value()),
      ranked(request.cost.has_value()),
      wheel_sinkage(request.wheel_sinkage),
      half(request.half),
      jacobians(request.extras.jacobians),
      covariance(request.extras.covariance),
      risk(request.extras.risk) {}

Result<v1::PredictRequest> to_message(const std::string& session_id, const PredictRequest& request) {
  if (std::optional<Error> fault = fault_of(request)) return *std::move(fault);
  const Asked asked(request);
  v1::PredictRequest message;
  message.set_session_id(session_id);
  if (request.start) set(message.mutable_start(), *request.start);
  if (request.start_stamp_ns) message.set_start_stamp_ns(*request.start_stamp_ns);
  for (const SentCommand& sent : request.sent) {
    v1::SentCommand& command = *message.add_sent();
    command.set_stamp_ns(sent.stamp_ns);
    set(command.mutable_command(), sent.command);
  }
  message.set_history_use(request.history_use == HistoryUse::none ? v1::HISTORY_USE_NONE : v1::HISTORY_USE_MEASURED);
  message.set_samples(static_cast<std::uint32_t>(asked.samples));
  message.set_horizon(static_cast<std::uint32_t>(asked.horizon));
  pack(request.controls.values(), *message.mutable_controls());
  if (request.drawing) set(message.mutable_drawing(), *request.drawing);
  if (request.cost) set(message.mutable_cost(), *request.cost);
  set(message.mutable_extras(), request.extras);
  message.mutable_output()->set_channels(request.channels);
  message.mutable_output()->set_stride(request.stride);
  message.mutable_output()->set_wheel_sinkage(request.wheel_sinkage);
  message.mutable_output()->set_precision(request.half ? v1::PRECISION_F16 : v1::PRECISION_F32);
  message.set_tag(request.tag);
  message.set_samples_min(request.samples_min);
  if (request.budget) message.set_budget_s(std::chrono::duration<double>(*request.budget).count());
  return message;
}

Result<Prediction> from_message(const v1::PredictReply& message, const Asked& asked) {
  Prediction prediction;
  prediction.tag = message.tag();
  prediction.samples = message.samples();
  prediction.steps = message.steps();
  prediction.soil_groups = std::max<std::size_t>(1, message.soil_groups());
  prediction.channels = message.channels();
  prediction.costs = unpack(message.costs());
  prediction.best.assign(message.best().begin(), message.best().end());
  prediction.mean_controls = unpack(message.mean_controls());
  if (!fits(message, prediction, asked)) return misfit("states");
  prediction.start = from_message(message.start());
  prediction.states_storage = states_from(message, prediction);
  prediction.sinkage_storage_m = is_half(message) ? unpack_half(message.sinkage_m()) : unpack(message.sinkage_m());
  prediction.drawn_storage = unpack(message.drawn_controls());
  prediction.validity.assign(message.validity().begin(), message.validity().end());
  if (message.has_start_stamp_ns()) prediction.start_stamp_ns = message.start_stamp_ns();
  prediction.rolled_forward_steps = message.rolled_forward_steps();
  prediction.history_steps = message.history_steps();
  prediction.soil = from_message(message.soil());
  if (message.has_soil_variance()) prediction.soil_variance = from_message(message.soil_variance());
  prediction.soil_correction = from_message(message.soil_correction());
  if (message.has_measurement_age_s()) prediction.measurement_age_s = message.measurement_age_s();
  prediction.provenance = from_message(message.provenance());
  prediction.queue_s = message.queue_s();
  prediction.compute_s = message.compute_s();
  auto extras = extra_outputs(message, prediction, asked);
  if (!extras) return extras.error();
  prediction.extras = std::move(*extras);
  return prediction;
}

PredictionAnswer from_message(const v1::PredictStreamReply& message, const Asked& asked) {
  switch (message.outcome_case()) {
    case v1::PredictStreamReply::kReply: return {message.reply().tag(), from_message(message.reply(), asked)};
    case v1::PredictStreamReply::kError:
      return {message.error().tag(), Error(code_from(message.error().code()), message.error().field(), message.error().message())};
    case v1::PredictStreamReply::OUTCOME_NOT_SET: break;
  }
  return {0, Error(Code::unknown, "", "an answer of a kind that this client does not know")};
}

}  // namespace nesam::detail
