// Goal: a planner that asks for it gets a prediction in every cycle, and is told when the service did not make it.
// Method: timeouts of zero, which no service can meet; what the numbers are is held against the Python client. A server that is gone is a matter of durable_test.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "check.hpp"
#include "minimal_nav2.hpp"
#include "scenario.hpp"

namespace {

using namespace std::chrono_literals;

nesam::KinematicFallback fallback_of(nesam::SecondCommand second, double wheelbase_m) {
  nesam::KinematicFallback fallback;
  fallback.vehicle.second = second;
  fallback.vehicle.wheelbase_m = wheelbase_m;
  fallback.vehicle.road_wheel_angle_max_rad = 0.5;
  return fallback;
}

/// x, y, yaw, vx, wz that `nesam.KinematicFallback` of the Python client gives for the same start, commands and cards, with a yaw that passes pi both ways.
/// Tolerance: some units in the last place of single precision.
void regress_the_numbers_of_the_python_client() {
  const nesam::VehicleState start = {{1.0, 2.0, 0.5}, {0.05, -0.02, 3.1}, {1.0, 0.1, 0.0}, {0.0, 0.0, 0.2}};
  const std::vector<float> commands = {2.0F, 0.5F, 1.5F, -0.25F, -1.0F, 0.5F, 0.0F, 1.0F};
  const struct {
    nesam::KinematicFallback fallback;
    double rows[4][5];
  } expected[] = {
      {fallback_of(nesam::SecondCommand::steering_normalised, 3.25),
       {{0.800115883, 2.00674582, 3.11571336, 2.0, 0.15713349},
        {0.650178194, 2.01106215, 3.10991383, 1.5, -0.0579946786},
        {0.75011456, 2.00750208, 3.10205722, -1.0, -0.0785667449},
        {0.75011456, 2.00750208, 3.10205722, 0.0, 0.0}}},
      {fallback_of(nesam::SecondCommand::road_wheel_angle_rad, 2.5),
       {{0.800054908, 2.0039475, -3.13948107, 2.0, 0.437041998},
        {0.650058687, 2.00477982, 3.12838364, 1.5, -0.153205156},
        {0.750027537, 2.00236654, 3.10653162, -1.0, -0.218520999},
        {0.750027537, 2.00236654, 3.10653162, 0.0, 0.0}}},
      {fallback_of(nesam::SecondCommand::yaw_rate_rad_s, 1.0),
       {{0.800048351, 2.00331807, -3.13318539, 2.0, 0.5},
        {0.650053501, 2.003932, 3.125, 1.5, -0.25},
        {0.750039577, 2.00477266, -3.10818529, -1.0, 0.5},
        {0.750039577, 2.00477266, -3.00818539, 0.0, 1.0}}},
  };
  constexpr std::array<std::size_t, 5> channels = {0, 1, 5, 6, 11};
  for (const auto& one : expected) {
    const std::vector<float> states = one.fallback.rollout(start, {nesam::Span<const float>(commands), 1, 4, 2});
    check(states.size() == 48, "shape");
    for (std::size_t k = 0; k < 4 && states.size() == 48; ++k) {
      const float* state = &states[12 * k];
      for (std::size_t i = 0; i < channels.size(); ++i) {
        check(std::abs(state[channels[i]] - one.rows[k][i]) < 1e-6, "step " + std::to_string(k) + ", channel " + std::to_string(channels[i]));
      }
      check(state[2] == 0.5F && state[3] == 0.05F && state[4] == -0.02F && state[7] == 0.0F && state[10] == 0.0F, "what the kinematics leave alone");
    }
  }
}

/// A bicycle to the left stays at its radius from a centre to the left.
void analytic_a_fallback_drives_arcs() {
  nesam::VehicleState start;
  start.attitude_rad[2] = 1.57079632679489662;
  std::vector<float> commands;
  for (int k = 0; k < 32; ++k) commands.insert(commands.end(), {2.0F, 0.3F});
  const auto states = fallback_of(nesam::SecondCommand::road_wheel_angle_rad, 2.5).rollout(start, {nesam::Span<const float>(commands), 1, 32, 2});
  const double radius_m = 2.5 / std::tan(static_cast<double>(0.3F));
  double off_m = 0.0;
  for (std::size_t k = 0; k < 32; ++k) off_m = std::max(off_m, std::abs(std::hypot(states[12 * k] + radius_m, states[12 * k + 1]) - radius_m));
  check(off_m < 1e-4, "off the arc by " + std::to_string(off_m) + " m");
}

void service_a_late_answer_falls_back_and_says_so(const nesam::Session& session, nesam::Client& client) {
  const auto controls = varied_controls(3, 8, session.vehicle());
  nesam::PredictRequest request = request_of(controls, 3, 8);
  request.tag = 5;
  check_error(session.predict(request, 0ns), nesam::Code::deadline_exceeded, "", "off unless asked for");
  request.fallback = nesam::KinematicFallback{session.vehicle()};
  const auto whole = session.predict(request, 0ns);
  if (!check_ok(whole, "a fallback")) return;
  const auto marked = [](const nesam::Prediction& prediction) {
    return prediction.computed_by == nesam::ComputedBy::kinematic_fallback && prediction.fallback_reason &&
           prediction.fallback_reason->code() == nesam::Code::deadline_exceeded;
  };
  check(marked(*whole) && whole->provenance.bundle_hash.empty() && std::isnan(whole->soil.k_phi) && whole->sinkage_m().empty(), "it says so");
  check(whole->states().fits() && whole->states().channels() == 12 && whole->rows() == 3 && whole->tag == 5, "shape");
  check(whole->validity == std::vector<std::uint32_t>(3, 0), "nothing is said of validity");
  check(whole->start.position_m == cruise(4, session.vehicle()).state.position_m, "from the newest measured state");
  const auto all = request.fallback->rollout(whole->start, request.controls);
  check(equal_bits(whole->states().values(), nesam::Span<const float>(all)), "the numbers are the fallback's");

  request.channels = nesam::bit(nesam::Channel::y) | nesam::bit(nesam::Channel::vx);
  request.stride = 3;
  request.start = nesam::VehicleState{};
  const auto some = session.predict(request, 0ns);
  if (!check_ok(some, "a selection")) return;
  const auto states = some->states();
  check(states.fits() && states.steps() == 2 && states.channels() == 2 && some->start.position_m[0] == 0.0, "shape of a selection");
  check(states(2, 1, *some->column(nesam::Channel::vx)) == controls[2 * (2 * 8 + 5)], "the step and the channel asked for");

  nesam::PredictRequest drawn;
  drawn.drawing = nesam::CandidateDrawing{24, nesam::Span<const float>(controls).subspan(0, 16), 0.5, 0.1, 0.8, 7};
  drawn.fallback = request.fallback;
  const auto nominal = session.predict(drawn, 0ns);
  check(nominal.ok() && nominal->rows() == 1 && equal_bits(nominal->states().values(), whole->states().sample(0)), "the nominal sequence of a drawing");
  check(nominal.ok() && equal_bits(nominal->drawn_controls().values(), drawn.drawing->nominal), "and which that is");

  // What the service would refuse is no answer of the fallback either: the error is that of the service.
  const auto refused = [&](std::size_t at, float value) {
    std::vector<float> wrong(controls.begin(), controls.end());
    wrong[at] = value;
    nesam::PredictRequest asked = request_of(wrong, 3, 8);
    asked.fallback = request.fallback;
    check_error(session.predict(asked, 0ns), nesam::Code::deadline_exceeded, "", "a command that nobody takes");
  };
  refused(4, static_cast<float>(session.vehicle().speed_max_m_s) + 0.01F);
  refused(47, static_cast<float>(session.vehicle().second_min) - 0.01F);
  refused(9, std::nanf(""));

  // A session that this client has not measured is known by where its predictions from now began, and is rolled forward from there.
  const nesam::Session copy = std::move(session.fork(unique("copy")).value());
  const nesam::Measurement newest = cruise(4, session.vehicle());
  const nesam::SentCommand sent[] = {{newest.stamp_ns, newest.command}, {newest.stamp_ns + 2 * grid_ns, {0.5, 0.0}}};
  nesam::PredictRequest ahead = request_of(controls, 3, 8);
  ahead.sent = sent;
  ahead.start_stamp_ns = newest.stamp_ns + 2 * grid_ns;
  const auto first = predicted(copy, ahead);
  ahead.start_stamp_ns = newest.stamp_ns + 3 * grid_ns;
  ahead.fallback = request.fallback;
  const auto next = copy.predict(ahead, 0ns);
  if (!check_ok(first, "from now") || !check_ok(next, "from now, late")) return;
  check(first->rolled_forward_steps == 2 && next->rolled_forward_steps == 3 && next->start_stamp_ns == ahead.start_stamp_ns, "from when");
  const std::vector<float> slower = {0.5F, 0.0F};
  const auto stepped = request.fallback->rollout(first->start, {nesam::Span<const float>(slower), 1, 1, 2});
  check(marked(*next) && std::abs(next->start.position_m[0] - stepped[0]) < 1e-5 && next->start.velocity_m_s[0] == 0.5, "with what was sent");
  ahead.start_stamp_ns = newest.stamp_ns + 35 * grid_ns;
  check_error(copy.predict(ahead, 0ns), nesam::Code::deadline_exceeded, "", "what is known is too old");

  // In time the service answers, and to a wrong question it says what is wrong.
  nesam::PredictRequest right = request_of(controls, 3, 8);
  const auto without = predicted(session, right);
  right.fallback = request.fallback;
  const auto within = predicted(session, right);
  check(within.ok() && within->computed_by == nesam::ComputedBy::service && !within->fallback_reason, "the service answers in time");
  check(within.ok() && without.ok() && equal_bits(within->states().values(), without->states().values()), "with the same bits as without");
  right.stride = 9;
  check_error(session.predict(right), nesam::Code::invalid_argument, "output.stride", "a stride beyond the horizon");

  // Of a session without a measurement nothing is known, and nothing is made up; a prediction tells where it began.
  nesam::OpenOptions options;
  options.vehicle_id = unique("unmeasured");
  nesam::Session blank = std::move(client.open(options).value());
  nesam::PredictRequest asked = request_of(controls, 3, 8);
  asked.fallback = request.fallback;
  check_error(blank.predict(asked, 0ns), nesam::Code::deadline_exceeded, "", "no state is known");
  {
    auto stream = blank.measurements();
    if (!check_ok(stream, "stream")) return;
    check(stream->send(cruise(2, blank.vehicle())).ok() && stream->receive(30s).ok(), "a measurement over a stream");
  }
  const auto streamed = blank.predict(asked, 0ns);
  check(streamed.ok() && streamed->start.position_m == cruise(2, blank.vehicle()).state.position_m, "its state is known");
  check_ok(blank.close(), "close");
  check_error(blank.predict(asked, 0ns), nesam::Code::deadline_exceeded, "", "a closed session is forgotten");
}

void service_the_motion_model_falls_back_every_cycle(const std::shared_ptr<nesam::Session>& session) {
  constexpr std::size_t batch = 3, time = 24;
  const auto fresh = [] {
    MinimalState<true> state(batch, time);
    for (std::size_t i = 0; i < batch; ++i) {
      for (std::size_t j = 0; j < time; ++j) {
        state.cvx(i, j) = 1.0F + 0.2F * static_cast<float>(i);
        state.cwz(i, j) = 0.05F * static_cast<float>(i) - 0.05F;
      }
      state.vx(i, 0) = state.cvx(i, 0);
      state.wz(i, 0) = state.cwz(i, 0);
    }
    return state;
  };
  nesam::MotionModelOptions options;
  options.timeout = 0ns;
  options.failures_max = 2;
  options.fallback = nesam::KinematicFallback{session->vehicle()};
  nesam::RemoteMotionModel<MinimalMotionModel<true>, MinimalState<true>> model(session, options);
  // More often than failures are borne.
  for (int cycle = 0; cycle < 5; ++cycle) {
    MinimalState<true> state = fresh();
    model.predict(state);
    const auto& prediction = model.rollout().prediction();
    check(model.rollout().failure() && model.rollout().failure()->code() == nesam::Code::deadline_exceeded, "the failure is told");
    check(prediction && prediction->computed_by == nesam::ComputedBy::kinematic_fallback && prediction->rows() == batch, "and who predicts");
    if (!prediction) return;
    const MinimalPose start = {prediction->start.position_m[0], prediction->start.position_m[1], prediction->start.attitude_rad[2]};
    double apart_m = 0.0, apart_rad_s = 0.0;
    for (std::size_t i = 0; i < batch; ++i) {
      for (std::size_t j = 1; j < time; ++j) {
        const MinimalPose pose = integrated(state, i, j, start, 0.1);
        const auto states = prediction->states();
        apart_m = std::max(apart_m, std::hypot(pose.x_m - states(i, j, 0), pose.y_m - states(i, j, 1)));
        apart_rad_s = std::max(apart_rad_s, static_cast<double>(std::abs(state.wz(i, j) - state.cwz(i, j))));
      }
    }
    check(apart_m < 1e-4, "integrated " + std::to_string(apart_m) + " m apart");
    // Kinematics turn as fast as they are told: a rate that is the difference of two angles in single precision, over 0.1 s.
    check(apart_rad_s < 1e-4, "turns " + std::to_string(apart_rad_s) + " rad/s apart");
  }

  // Without it, as before: the commands twice, then the planner is told.
  nesam::MotionModelOptions without;
  without.timeout = options.timeout;
  without.failures_max = options.failures_max;
  nesam::RemoteMotionModel<MinimalMotionModel<true>, MinimalState<true>> strict(session, without);
  int told = 0;
  for (int cycle = 0; cycle < 3; ++cycle) {
    MinimalState<true> state = fresh();
    try {
      strict.predict(state);
      check(!strict.rollout().prediction() && state.vx(2, 5) == state.cvx(2, 4), "the commands are followed");
    } catch (const nesam::Error& error) {
      told += error.code() == nesam::Code::deadline_exceeded ? 1 : 100;
    }
  }
  check(told == 1, "the third failure in a row is thrown");
}

void run_all(nesam::Client& client) {
  run("regress_the_numbers_of_the_python_client", regress_the_numbers_of_the_python_client);
  run("analytic_a_fallback_drives_arcs", analytic_a_fallback_drives_arcs);
  const FlatMap flat;
  const std::string map_id = unique("fallback");
  client.upload_map(flat.view(map_id, 1)).value();
  {
    const auto session = std::make_shared<nesam::Session>(driven(client, "late", map_id));
    run("service_a_late_answer_falls_back_and_says_so", [&] { service_a_late_answer_falls_back_and_says_so(*session, client); });
    run("service_the_motion_model_falls_back_every_cycle", [&] { service_the_motion_model_falls_back_every_cycle(session); });
  }
  client.delete_map(map_id).value();
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
