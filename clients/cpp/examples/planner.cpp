// A random-shooting planner in its smallest form: drives to a goal by predicting many random command sequences and taking the best one.
//
// There is no vehicle here, so the predicted next state is taken for the measured one: this shows how a planner is wired, not how well the model predicts.
// In a vehicle the measurements come from its localisation, at any rate, and the planner only calls `predict`.
//
// Usage: planner HOST:PORT [STEPS]        Exit code 0 = arrived or no steps left, 1 = a call failed, 2 = wrong usage, 130 = interrupted; the session is closed in any case.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <random>
#include <string>
#include <vector>

namespace {

constexpr std::size_t samples = 64;
constexpr std::size_t horizon = 32;
constexpr double goal_x_m = 12.0;
constexpr double goal_y_m = 4.0;

volatile std::sig_atomic_t interrupted = 0;

/// Random command sequences, shape (samples, horizon, 2): first-order autoregressive noise, so that a vehicle can follow them.
std::vector<float> draw(const nesam::VehicleCard& card, std::mt19937& random) {
  std::normal_distribution<double> normal;
  constexpr double memory = 0.8;
  const double fresh = std::sqrt(1.0 - memory * memory);
  const double cruise_m_s = 0.5 * std::min(card.speed_max_m_s, 6.0);
  std::vector<float> controls;
  controls.reserve(samples * horizon * 2);
  for (std::size_t n = 0; n < samples; ++n) {
    double speed_noise = normal(random);
    double second_noise = normal(random);
    for (std::size_t k = 0; k < horizon; ++k) {
      speed_noise = memory * speed_noise + fresh * normal(random);
      second_noise = memory * second_noise + fresh * normal(random);
      const double speed_m_s = std::clamp(cruise_m_s * (1.0 + 0.3 * speed_noise), std::max(0.0, card.speed_min_m_s), card.speed_max_m_s);
      const double second = std::clamp(0.5 * second_noise * card.second_max, card.second_min, card.second_max);
      controls.push_back(static_cast<float>(speed_m_s));
      controls.push_back(static_cast<float>(second));
    }
  }
  return controls;
}

/// Distance to the goal where a sample comes nearest, m; a sample that cannot be trusted costs more than any other.
double cost(const nesam::Prediction& prediction, std::size_t n) {
  constexpr std::uint32_t hopeless = nesam::validity_not_finite | nesam::validity_off_map | nesam::validity_overturned;
  if ((prediction.validity[n] & hopeless) != 0) return 1e9;
  const auto states = prediction.states();
  double nearest_m = std::numeric_limits<double>::infinity();
  for (std::size_t k = 0; k < states.steps(); ++k) nearest_m = std::min(nearest_m, std::hypot(states(n, k, 0) - goal_x_m, states(n, k, 1) - goal_y_m));
  return nearest_m;
}

nesam::VehicleState state_of(nesam::Span<const float> values) {
  const auto three = [&](std::size_t i) { return std::array<double, 3>{values[i], values[i + 1], values[i + 2]}; };
  return {three(0), three(3), three(6), three(9)};
}

void drive(const std::string& target, int steps) {
  nesam::Client client(target);
  nesam::OpenOptions options;
  options.vehicle_id = "planner-example";
  nesam::Session session = std::move(client.open(options).value());
  std::printf("vehicle %s, %zu samples x %zu steps, no map\n", session.vehicle().name.c_str(), samples, horizon);

  std::mt19937 random(1);
  nesam::Measurement now;
  for (int step = 0; step < steps && !interrupted; ++step) {
    now.stamp_ns += 100'000'000;
    now.sequence += 1;
    if (!session.send(now).value().accepted()) {
      std::printf("step %d: the measurement was refused\n", step);
      return;
    }
    const std::vector<float> controls = draw(session.vehicle(), random);
    nesam::PredictRequest request;
    request.controls = {nesam::Span<const float>(controls), samples, horizon, 2};
    const nesam::Prediction prediction = session.predict(request).value();
    std::size_t best = 0;
    for (std::size_t n = 1; n < samples; ++n) {
      if (cost(prediction, n) < cost(prediction, best)) best = n;
    }
    now.command = {request.controls(best, 0, 0), request.controls(best, 0, 1)};
    now.state = state_of(prediction.states().step(best, 0));
    const double left_m = std::hypot(now.state.position_m[0] - goal_x_m, now.state.position_m[1] - goal_y_m);
    std::printf("t %4.1f s  x %6.2f m  y %6.2f m  to go %5.2f m  computed in %.1f ms\n", 0.1 * (step + 1), now.state.position_m[0], now.state.position_m[1], left_m,
                1e3 * prediction.compute_s);
    if (left_m < 1.0) {
      std::printf("arrived\n");
      return;
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  const bool help = argc == 2 && (std::string(argv[1]) == "--help" || std::string(argv[1]) == "-h");
  const int steps = argc == 3 ? std::atoi(argv[2]) : 60;
  if (help || (argc != 2 && argc != 3) || steps < 1) {
    std::fprintf(help ? stdout : stderr, "usage: planner HOST:PORT [STEPS]\n");
    return help ? 0 : 2;
  }
  std::signal(SIGINT, [](int) { interrupted = 1; });
  try {
    drive(argv[1], steps);
  } catch (const nesam::Error& error) {
    std::fprintf(stderr, "planner: %s\n", error.what());
    return 1;
  }
  return interrupted ? 130 : 0;
}
