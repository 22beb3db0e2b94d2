#pragma once

// What the tests drive: a flat map, a straight drive and admitted commands.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <thread>
#include <utility>
#include <vector>

inline constexpr float nan_f = std::numeric_limits<float>::quiet_NaN();
inline constexpr double nan_d = std::numeric_limits<double>::quiet_NaN();
inline constexpr std::int64_t grid_ns = 100'000'000;

/// Names that no other run uses, so that the test can be repeated against a server that keeps running.
inline std::string unique(const std::string& name) {
  static const auto run = std::chrono::system_clock::now().time_since_epoch().count();
  return name + "-" + std::to_string(run);
}

/// A flat map, 40 m x 40 m around the origin, of one colour.
struct FlatMap {
  static constexpr std::uint32_t side = 81;
  std::vector<float> elevation_m = std::vector<float>(std::size_t{side} * side, 0.0F);
  std::vector<std::uint8_t> rgb = std::vector<std::uint8_t>(std::size_t{3} * side * side, 120);

  nesam::Map view(const std::string& id, std::uint64_t version) const {
    nesam::Map map;
    map.id = id;
    map.version = version;
    map.geometry = {{-20.0, -20.0}, 0.5, side, side};
    map.elevation_m = elevation_m;
    map.semantic_rgb = rgb;
    return map;
  }
};

/// The same with hills of 0.3 m, some metres wide.
struct HillyMap : FlatMap {
  HillyMap() {
    for (std::size_t row = 0; row < side; ++row) {
      for (std::size_t column = 0; column < side; ++column) {
        elevation_m[row * side + column] = 0.3F * std::sin(0.5F * static_cast<float>(column)) * std::cos(0.3F * static_cast<float>(row));
      }
    }
  }
};

/// Straight ahead at 1 m/s along x, step by step of 0.1 s.
inline nesam::Measurement cruise(int step, const nesam::VehicleCard& card) {
  nesam::Measurement measurement;
  measurement.stamp_ns = 1'000'000'000 + step * grid_ns;
  measurement.sequence = static_cast<std::uint64_t>(step) + 1;
  measurement.state.position_m = {0.1 * step, 0.0, 0.5};
  measurement.state.velocity_m_s = {1.0, 0.0, 0.0};
  measurement.command = {std::min(1.0, card.speed_max_m_s), 0.0};
  return measurement;
}

/// Admitted commands that differ in every entry, shape (samples, horizon, 2).
inline std::vector<float> varied_controls(std::size_t samples, std::size_t horizon, const nesam::VehicleCard& card) {
  std::vector<float> controls;
  for (std::size_t i = 0; i < samples * horizon; ++i) {
    const double speed_share = 0.25 + 0.2 * std::sin(0.37 * static_cast<double>(i));
    const double second_share = 0.5 + 0.3 * std::sin(0.11 * static_cast<double>(i));
    const double slowest_m_s = std::max(0.0, card.speed_min_m_s);
    controls.push_back(static_cast<float>(slowest_m_s + speed_share * (std::min(card.speed_max_m_s, 6.0) - slowest_m_s)));
    controls.push_back(static_cast<float>(card.second_min + second_share * (card.second_max - card.second_min)));
  }
  return controls;
}

inline nesam::PredictRequest request_of(const std::vector<float>& controls, std::size_t samples, std::size_t horizon) {
  nesam::PredictRequest request;
  request.controls = {nesam::Span<const float>(controls), samples, horizon, 2};
  return request;
}

/// A state from its twelve channels.
inline nesam::VehicleState state_of(nesam::Span<const float> values) {
  const auto three = [&](std::size_t i) { return std::array<double, 3>{values[i], values[i + 1], values[i + 2]}; };
  return {three(0), three(3), three(6), three(9)};
}

/// Asks for a prediction, and again while the service is overloaded: beside other work the machine may be slow for a while.
inline nesam::Result<nesam::Prediction> predicted(const nesam::Session& session, const nesam::PredictRequest& request) {
  for (int attempt = 1;; ++attempt) {
    auto prediction = session.predict(request);
    if (prediction || prediction.error().code() != nesam::Code::resource_exhausted || attempt == 20) return prediction;
    std::this_thread::sleep_for(std::chrono::milliseconds(200));
  }
}

/// A session of its own on a map, driven for five steps.
inline nesam::Session driven(nesam::Client& client, const std::string& name, const std::string& map_id) {
  nesam::OpenOptions options;
  options.vehicle_id = unique(name);
  options.map_id = map_id;
  nesam::Session session = std::move(client.open(options).value());
  for (int step = 0; step < 5; ++step) (void)session.send(cruise(step, session.vehicle())).value();
  return session;
}

/// Measurements that follow the model's own prediction after those of `driven`, so that the filter of the soil takes them.
inline std::vector<nesam::Measurement> predicted_drive(const nesam::Session& session) {
  constexpr std::size_t horizon = nesam::horizon_max;
  const auto controls = varied_controls(1, horizon, session.vehicle());
  nesam::PredictRequest request = request_of(controls, 1, horizon);
  const nesam::Prediction prediction = predicted(session, request).value();
  std::vector<nesam::Measurement> drive;
  for (std::size_t k = 0; k < horizon; ++k) {
    nesam::Measurement measurement = cruise(5 + static_cast<int>(k), session.vehicle());
    measurement.state = state_of(prediction.states().step(0, k));
    const std::size_t next = std::min(k + 1, horizon - 1);
    measurement.command = {controls[2 * next], controls[2 * next + 1]};
    drive.push_back(measurement);
  }
  return drive;
}
