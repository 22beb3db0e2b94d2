// Goal: the client against a real server, method by method; every bad input must come back as the right typed error and leave the session as it was.
// Method: one session on an uploaded flat map, one without a map. Expected values are exact where the protocol promises them (echoes, shapes, codes, fields,
// equal bits of a row in any batch) and loose where only physics does.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "check.hpp"
#include "minimal_nav2.hpp"
#include "scenario.hpp"

namespace {

using namespace std::chrono_literals;

void analytic_views_index_row_major() {
  std::vector<float> values(2 * 3 * 4);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(i);
  const nesam::View3<float> view(values, 2, 3, 4);
  const nesam::View3<const float> read = view;
  check(view.fits() && read.fits(), "the shape fits");
  check(read(1, 2, 3) == 23.0F && read(0, 1, 0) == 4.0F, "an entry");
  check(read.sample(1).size() == 12 && read.sample(1)[0] == 12.0F && read.step(1, 1)[2] == 18.0F, "a sample and a step");
  const nesam::Span<const float> span = values;
  check(!nesam::View3<const float>(span, 2, 3, 5).fits() && !nesam::View3<const float>(span, 0, 3, 4).fits(), "wrong shapes do not fit");
  const std::size_t huge = std::numeric_limits<std::size_t>::max();
  check(!nesam::View3<const float>(span, huge, huge, 2).fits() && nesam::View3<const float>().fits(), "a product that overflows does not fit");
}

void analytic_channels_have_columns() {
  nesam::Prediction prediction;
  prediction.channels = nesam::bit(nesam::Channel::x) | nesam::bit(nesam::Channel::yaw) | nesam::bit(nesam::Channel::wz);
  check(prediction.channel_count() == 3 && prediction.column(nesam::Channel::yaw) == 1 && prediction.column(nesam::Channel::wz) == 2, "columns");
  check(!prediction.column(nesam::Channel::y), "a channel that was not asked for");
}

void service_maps(nesam::Client& client) {
  const FlatMap flat;
  const std::string id = unique("flat");
  const auto described = client.upload_map(flat.view(id, 1));
  check(described.ok(), described.ok() ? "" : described.error().what());
  if (!described) return;
  check(described->id == id && described->version == 1 && described->semantic && described->hash.size() == 64, "description");
  check(described->geometry.width == FlatMap::side && described->geometry.origin_m[0] == -20.0 && described->geometry.resolution_m == 0.5, "geometry");
  check_error(client.upload_map(flat.view(id, 1)), nesam::Code::already_exists, "map_id", "the same version again");
  check_error(client.upload_map(flat.view(id, 0)), nesam::Code::invalid_argument, "header.version", "version 0");
  check_error(client.upload_map(flat.view("not/a/name", 1)), nesam::Code::invalid_argument, "header.map_id", "a bad name");
  nesam::Map small = flat.view(id, 2);
  small.geometry.height = FlatMap::side + 1;
  check_error(client.upload_map(small), nesam::Code::invalid_argument, "elevation_m", "a layer too small for its geometry");
  const auto maps = client.maps();
  check(maps.ok() && std::any_of(maps->begin(), maps->end(), [&](const auto& map) { return map.id == id && map.version == 1; }), "the list has it");

  // More than one tile: 700 x 700 cells of 7 bytes are 3.4 MB.
  const std::uint32_t side = 700;
  const std::vector<float> elevation_m(std::size_t{side} * side, 1.0F);
  const std::vector<std::uint8_t> rgb(std::size_t{3} * side * side, 90);
  const std::string large_id = unique("large");
  const nesam::Map large{large_id, 3, {{0.0, 0.0}, 0.1, side, side}, elevation_m, rgb, -5, "odom"};
  const auto uploaded = client.upload_map(large);
  check(uploaded.ok() && uploaded->version == 3, uploaded.ok() ? "large map" : uploaded.error().what());
  check(uploaded.ok() && uploaded->stamp_ns == -5 && uploaded->frame == "odom" && !described->stamp_ns && described->frame.empty(), "stamp and frame");

  nesam::OpenOptions options;
  options.vehicle_id = unique("mapper");
  options.map_id = id;
  {
    const auto session = client.open(options);
    check(session.ok(), session.ok() ? "" : session.error().what());
    check_error(client.delete_map(id), nesam::Code::failed_precondition, "map_id", "deleting a map in use");
  }
  check(client.delete_map(id).ok() && client.delete_map(large_id).ok(), "deleting unused maps");
  check_error(client.delete_map(id), nesam::Code::not_found, "map_id", "deleting an unknown map");
}

void service_sessions_are_raii(nesam::Client& client) {
  nesam::OpenOptions options;
  options.vehicle_id = unique("raii");
  {
    auto session = client.open(options);
    check(session.ok() && session->id() == options.vehicle_id, session.ok() ? "id" : session.error().what());
    check_error(client.open(options), nesam::Code::already_exists, "session_id", "opening twice");
    const nesam::Session moved = std::move(*session);
    check(moved.status().ok(), "open after a move");
    const auto sessions = client.sessions();
    check(sessions.ok() && std::any_of(sessions->begin(), sessions->end(), [&](const auto& s) { return s.session_id == moved.id(); }), "the list has it");
  }
  check_error(client.session(options.vehicle_id), nesam::Code::not_found, "session_id", "closed by the destructor");

  std::string id;
  {
    auto session = client.open(options);
    check(session.ok(), "opening again");
    if (session) id = session->detach();
  }
  auto attached = client.attach(id);
  check(attached.ok() && attached->close().ok(), "left open by detach, closed by attach");
  if (attached) check_error(attached->close(), nesam::Code::not_found, "session_id", "closing twice");
  check_error(client.attach(id), nesam::Code::not_found, "session_id", "attaching to a closed session");

  options.vehicle_id = unique("first");
  {
    auto first = client.open(options);
    nesam::OpenOptions other = options;
    other.vehicle_id = unique("second");
    auto second = client.open(other);
    if (first && second) *first = std::move(*second);
    check_error(client.session(options.vehicle_id), nesam::Code::not_found, "session_id", "the replaced session is closed");
    check(client.session(other.vehicle_id).ok(), "the session that replaced it is open");
  }

  // As after a restart of the server: the session is gone, and the new one takes the place of the old object.
  options.vehicle_id = unique("again");
  {
    auto session = client.open(options);
    check(session.ok() && client.close(options.vehicle_id).ok(), "open and lost");
    auto again = client.open(options);
    if (session && again) *session = std::move(*again);
    check(client.session(options.vehicle_id).ok(), "the old object does not close the session that was opened again");
  }
  check_error(client.session(options.vehicle_id), nesam::Code::not_found, "session_id", "the new object closes it");

  options.vehicle_id = "";
  check_error(client.open(options), nesam::Code::invalid_argument, "vehicle_id", "no name");
  for (const char* wrong : {"truck-7\n", "Bj\xc3\xb6rn"}) {
    nesam::ClientOptions of_nobody;
    of_nobody.vehicle_id = wrong;
    nesam::Client nobody("127.0.0.1:1", of_nobody);
    check_error(nobody.session("truck-7"), nesam::Code::invalid_argument, "vehicle_id", "a vehicle that is no name");
  }
  options.vehicle_id = unique("raii");
  options.map_id = "no-such-map";
  check_error(client.open(options), nesam::Code::not_found, "map_id", "an unknown map");
}

void service_measurements_get_typed_answers(nesam::Session& session) {
  const nesam::VehicleCard& card = session.vehicle();
  for (int step = 0; step < 5; ++step) {
    const auto answer = session.send(cruise(step, card));
    check(answer.ok() && answer->accepted() && answer->sequence == static_cast<std::uint64_t>(step) + 1, answer.ok() ? "echo" : answer.error().what());
    if (!answer) return;
    check(answer->session_id == session.id() && answer->stamp_ns == cruise(step, card).stamp_ns, "echo of id and stamp");
    check(answer->history_epoch == static_cast<std::uint64_t>(step) + 1, "epoch");
    if (const auto* applied = answer->is<nesam::Applied>()) check(applied->history_steps == static_cast<std::uint32_t>(step) + 1, "history steps");
  }
  // Several at once: denser than the grid, again, too late, not finite, out of the card, on the grid.
  std::vector<nesam::Measurement> batch(6, cruise(4, card));
  batch[0].stamp_ns += grid_ns / 10;
  batch[0].sequence = 6;
  batch[2].stamp_ns -= 3 * grid_ns + 1;
  batch[3] = cruise(5, card);
  batch[3].sequence = 7;
  batch[3].state.velocity_m_s[0] = nan_d;
  batch[4] = cruise(5, card);
  batch[4].sequence = 8;
  batch[4].command.speed_m_s = card.speed_max_m_s + 1.0;
  batch[5] = cruise(5, card);
  batch[5].sequence = 9;
  batch[5].wheel_speed_rad_s = {2.0, 2.0, 2.0, 2.0};
  const auto answers = session.send(nesam::Span<const nesam::Measurement>(batch));
  check(answers.ok() && answers->size() == batch.size(), answers.ok() ? "one answer each" : answers.error().what());
  if (!answers || answers->size() != batch.size()) return;
  const auto* buffered = (*answers)[0].is<nesam::Buffered>();
  check(buffered && std::abs(buffered->next_step_in_s - 0.09) < 1e-6, "BUFFERED");
  check((*answers)[1].is<nesam::Duplicate>() && !(*answers)[1].accepted(), "DUPLICATE");
  const auto* old = (*answers)[2].is<nesam::TooOld>();
  check(old && std::abs(old->behind_s - 0.31) < 1e-6, "TOO_OLD");
  const auto* not_finite = (*answers)[3].is<nesam::NotFinite>();
  check(not_finite && not_finite->field == "state.velocity_m_s.x", "NOT_FINITE");
  const auto* rejected = (*answers)[4].is<nesam::Rejected>();
  check(rejected && rejected->code == nesam::Code::invalid_argument && rejected->field == "command.speed_m_s" && !rejected->message.empty(), "REJECTED");
  check((*answers)[5].accepted() && (*answers)[5].history_epoch == 6, "bad measurements before it changed nothing");
  const auto status = session.status();
  check(status.ok() && status->history_steps == 6 && status->last_sequence == 9 && status->last_stamp_ns == batch[5].stamp_ns, "status");
  check(status.ok() && status->state && status->state->position_m[0] == batch[5].state.position_m[0], "state of the newest step");
}

void service_predictions(const nesam::Session& session, const std::string& map_id) {
  constexpr std::size_t samples = 7;
  constexpr std::size_t horizon = 32;
  const auto controls = varied_controls(samples, horizon, session.vehicle());
  nesam::PredictRequest request = request_of(controls, samples, horizon);
  request.wheel_sinkage = true;
  request.tag = 77;
  const auto batch = session.predict(request);
  check(batch.ok(), batch.ok() ? "" : batch.error().what());
  if (!batch) return;
  const auto states = batch->states();
  check(states.samples() == samples && states.steps() == horizon && states.channels() == 12 && states.fits(), "shape of the states");
  check(batch->sinkage_m().channels() == 4 && batch->sinkage_m().fits(), "shape of the sinkage");
  check(std::all_of(states.values().begin(), states.values().end(), [](float v) { return std::isfinite(v); }), "finite states");
  check(batch->tag == 77 && batch->channels == nesam::all_channels && batch->validity.size() == samples, "tag, channels, validity");
  check(batch->history_steps == 5 && batch->start.position_m[0] == 0.5, "starts at the newest measurement");
  check(batch->provenance.map_id == map_id && batch->provenance.history_epoch == 6 && batch->provenance.bundle_hash.size() == 64, "provenance");
  check(batch->soil.k_phi > 0.0 && batch->measurement_age_s && *batch->measurement_age_s >= 0.0 && batch->compute_s > 0.0, "soil, age, time");
  const auto off_map = [](std::uint32_t bits) { return (bits & (nesam::validity_off_map | nesam::validity_no_map)) != 0; };
  check(std::none_of(batch->validity.begin(), batch->validity.end(), off_map), "on the map");
  // 3.2 s at 1 m/s and more from x = 0.5 m; generous, because the model is what the bundle says.
  check(states(0, horizon - 1, 0) > 0.5F && states(0, horizon - 1, 0) < 25.0F, "moves forward: x = " + std::to_string(states(0, horizon - 1, 0)) + " m");

  for (const std::size_t n : {std::size_t{0}, std::size_t{3}, samples - 1}) {
    const std::vector<float> row(request.controls.sample(n).begin(), request.controls.sample(n).end());
    nesam::PredictRequest alone = request_of(row, 1, horizon);
    alone.wheel_sinkage = true;
    const auto single = session.predict(alone);
    check(single.ok() && equal_bits(single->states().sample(0), states.sample(n)), "row " + std::to_string(n) + " alone has the bits of the batch");
    check(single.ok() && equal_bits(single->sinkage_m().sample(0), batch->sinkage_m().sample(n)), "sinkage of row " + std::to_string(n));
  }

  nesam::PredictRequest selection = request_of(controls, samples, horizon);
  selection.channels = nesam::bit(nesam::Channel::y) | nesam::bit(nesam::Channel::vx);
  selection.stride = 5;
  const auto some = session.predict(selection);
  check(some.ok() && some->states().steps() == 6 && some->states().channels() == 2 && some->sinkage_m().values().empty(), "shape of a selection");
  bool equal = some.ok();
  for (std::size_t n = 0; equal && n < samples; ++n) {
    for (std::size_t k = 0; k < 6; ++k) {
      equal = equal && some->states()(n, k, 0) == states(n, 5 * k + 4, 1) && some->states()(n, k, *some->column(nesam::Channel::vx)) == states(n, 5 * k + 4, 6);
    }
  }
  check(equal, "a selection is a part of the whole");

  nesam::PredictRequest elsewhere = request_of(controls, samples, horizon);
  elsewhere.start = batch->start;
  elsewhere.start->position_m[0] = -5.0;
  elsewhere.history_use = nesam::HistoryUse::none;
  const auto what_if = session.predict(elsewhere);
  check(what_if.ok() && what_if->history_steps == 0 && what_if->start.position_m[0] == -5.0, "a start of its own");
}

void service_the_service_draws_and_ranks(const nesam::Session& session) {
  constexpr std::size_t horizon = 16;
  const auto nominal = varied_controls(1, horizon, session.vehicle());
  nesam::PredictRequest request;
  request.drawing = nesam::CandidateDrawing{24, nesam::Span<const float>(nominal), 0.5, 0.1, 0.8, 7};
  const auto all = session.predict(request);
  check(all.ok() && all->rows() == 24 && all->states().fits() && all->drawn_controls().fits() && all->costs.empty(), all.ok() ? "all" : all.error().what());
  if (!all) return;
  check(equal_bits(all->drawn_controls().sample(0), nominal), "the first candidate is the nominal one");
  nesam::PredictRequest sent;
  sent.controls = all->drawn_controls();
  const auto again = session.predict(sent);
  check(again.ok() && equal_bits(again->states().values(), all->states().values()), "the drawn candidates, sent, give the same bits");

  const std::vector<float> path = {-5.0F, 0.0F, 15.0F, 0.0F};
  request.cost = nesam::PathCost{};
  request.cost->path_m = nesam::Span<const float>(path);
  request.cost->speed_weight = 0.5;
  request.cost->speed_m_s = 2.0;
  request.cost->best = 3;
  request.cost->temperature = 0.2;
  const auto ranked = session.predict(request);
  check(ranked.ok() && ranked->rows() == 3 && ranked->states().samples() == 3 && ranked->costs.size() == 24, ranked.ok() ? "three" : ranked.error().what());
  if (!ranked) return;
  check(*std::min_element(ranked->costs.begin(), ranked->costs.end()) == ranked->costs[ranked->best[0]], "the best is the cheapest");
  for (std::size_t row = 0; row < 3; ++row) {
    check(equal_bits(ranked->states().sample(row), all->states().sample(ranked->best[row])), "a row is that of its candidate");
  }
  check(ranked->mean_controls.size() == 2 * horizon && ranked->validity.size() == 3, "mean and validity");
  request.controls = sent.controls;
  check_error(session.predict(request), nesam::Code::invalid_argument, "controls", "candidates sent and drawn");
  request.controls = {};
  request.drawing->correlation = 1.0;
  check_error(session.predict(request), nesam::Code::invalid_argument, "drawing.correlation", "a correlation of one");
}

void analytic_commands_ask_for_a_twist() {
  nesam::VehicleCard card;
  card.speed_min_m_s = -2.0;
  card.speed_max_m_s = 6.0;
  card.wheelbase_m = 2.0;
  card.second = nesam::SecondCommand::road_wheel_angle_rad;
  card.second_min = -0.6;
  card.second_max = 0.6;
  const auto near = [](double a, double b) { return std::abs(a - b) < 1e-12; };
  check(near(nesam::command_from_twist(card, 4.0, 0.5).second, std::atan(0.25)), "a bicycle turns with tan(angle) / wheelbase per metre");
  check(near(nesam::command_from_twist(card, -1.0, 0.2).second, -std::atan(0.4)), "backwards the wheels point the other way");
  check(near(nesam::command_from_twist(card, 0.0, 3.0).second, 0.6) && nesam::command_from_twist(card, 9.0, 0.0).speed_m_s == 6.0, "cut to the card");
  card.second = nesam::SecondCommand::steering_normalised;
  card.second_min = -1.0;
  card.second_max = 1.0;
  card.road_wheel_angle_max_rad = 0.5;
  check(near(nesam::command_from_twist(card, 4.0, 0.5).second, std::atan(0.25) / 0.5), "normalised");
  card.second = nesam::SecondCommand::yaw_rate_rad_s;
  check(near(nesam::command_from_twist(card, 4.0, 0.5).second, 0.5), "a yaw rate stays one");
}

/// Planner's arrays of one shape: what nav2 integrates out of them must be what the service predicted.
template <bool eigen>
void check_motion_model(const std::shared_ptr<nesam::Session>& session, double model_dt_s, bool lateral) {
  constexpr std::size_t batch = 5;
  const std::size_t fineness = static_cast<std::size_t>(std::lround(0.1 / model_dt_s));
  const std::size_t time = 12 * fineness;
  MinimalState<eigen> state(batch, time);
  for (std::size_t i = 0; i < batch; ++i) {
    state.vx(i, 0) = 1.0F;
    for (std::size_t j = 0; j < time; ++j) {
      state.cvx(i, j) = 1.0F + 0.2F * static_cast<float>(i);
      state.cwz(i, j) = 0.1F * static_cast<float>(i) - 0.2F;
    }
  }
  nesam::MotionModelOptions options;
  options.model_dt_s = model_dt_s;
  options.lateral = lateral;
  options.timeout = 30s;
  nesam::RemoteMotionModel<MinimalMotionModel<eigen>, MinimalState<eigen>> model(session, options);
  MinimalMotionModel<eigen>& as_nav2_sees_it = model;
  as_nav2_sees_it.predict(state);
  check(as_nav2_sees_it.isHolonomic() == lateral && !model.rollout().failure(), "lateral or not");
  const auto& prediction = model.rollout().prediction();
  check(prediction && prediction->rows() == batch && prediction->states().steps() == 12, "shape of the prediction");
  if (!prediction) return;
  const MinimalPose start = {prediction->start.position_m[0], prediction->start.position_m[1], prediction->start.attitude_rad[2]};
  double apart_m = 0.0, apart_rad = 0.0;
  for (std::size_t i = 0; i < batch; ++i) {
    check(state.vx(i, 0) == 1.0F && state.vy(i, 0) == 0.0F, "the first column is the planner's");
    for (std::size_t k = 1; k < 12; ++k) {
      const MinimalPose pose = integrated(state, i, (k + 1) * fineness - 1, start, model_dt_s);
      const auto states = prediction->states();
      apart_m = std::max(apart_m, std::hypot(pose.x_m - states(i, k, 0), pose.y_m - states(i, k, 1)));
      apart_rad = std::max(apart_rad, std::abs(std::remainder(pose.yaw_rad - states(i, k, 2), 2.0 * 3.14159265358979)));
    }
  }
  // Without lateral velocities the heading is right, and what the reference point moves sideways in a bend is lost.
  check(apart_m < (lateral ? 1e-4 : 0.5) && apart_rad < 1e-4, "integrated " + std::to_string(apart_m) + " m and " + std::to_string(apart_rad) + " rad apart");
}

/// A motion model that asks from now begins there, with the commands on their way, as a prediction that is asked so.
void service_motion_model_from_now(nesam::Client& client, const std::string& map_id) {
  using State = MinimalState<true>;
  using Model = nesam::RemoteMotionModel<MinimalMotionModel<true>, State>;
  const auto session = std::make_shared<nesam::Session>(driven(client, "from-now", map_id));
  const nesam::VehicleCard& card = session->vehicle();
  const std::int64_t newest_ns = cruise(4, card).stamp_ns;
  std::int64_t now_ns = newest_ns + 2 * grid_ns + grid_ns / 5;
  nesam::MotionModelOptions options;
  options.timeout = 30s;
  options.failures_max = 2;
  options.now = [&] { return now_ns; };
  Model model(session, options);
  // Of no use any more, of a clock that was set back afterwards, no number, and what is on its way.
  model.sent(newest_ns - 40 * grid_ns, 0.2, 0.0);
  model.sent(newest_ns + 90 * grid_ns, 0.2, 0.0);
  model.sent(newest_ns - grid_ns, 1.0, 0.0);
  model.sent(newest_ns + grid_ns, nan_d, 0.0);
  model.sent(newest_ns + grid_ns, 3.0, 0.3);
  constexpr std::size_t batch = 4, time = 24;
  const auto fresh = [](std::size_t columns) {
    State state(batch, columns);
    for (std::size_t i = 0; i < batch; ++i) {
      for (std::size_t j = 0; j < columns; ++j) {
        state.cvx(i, j) = 1.0F + 0.2F * static_cast<float>(i);
        state.cwz(i, j) = 0.1F * static_cast<float>(i) - 0.2F;
      }
    }
    return state;
  };
  State state = fresh(time);
  model.predict(state);
  const auto& prediction = model.rollout().prediction();
  check(!model.rollout().failure() && prediction, model.rollout().failure() ? model.rollout().failure()->what() : "a prediction");
  if (!prediction) return;
  check(prediction->start_stamp_ns == newest_ns + 2 * grid_ns && prediction->rolled_forward_steps == 2, "it begins at the nearest step to now");

  std::vector<float> controls;
  for (std::size_t i = 0; i < batch; ++i) {
    for (std::size_t j = 0; j < time; ++j) {
      const nesam::Control control = nesam::command_from_twist(card, state.cvx(i, j), state.cwz(i, j));
      controls.insert(controls.end(), {static_cast<float>(control.speed_m_s), static_cast<float>(control.second)});
    }
  }
  const nesam::SentCommand sent[] = {{newest_ns + grid_ns, nesam::command_from_twist(card, 3.0, 0.3)}};
  nesam::PredictRequest request = request_of(controls, batch, time);
  request.channels = nesam::bit(nesam::Channel::x) | nesam::bit(nesam::Channel::y) | nesam::bit(nesam::Channel::yaw);
  request.start_stamp_ns = now_ns;
  request.sent = sent;
  const auto asked = predicted(*session, request);
  check(asked.ok() && equal_bits(asked->states().values(), prediction->states().values()), "the bits of a prediction that is asked so");
  request.sent = {};
  const auto without = predicted(*session, request);
  check(without.ok() && !equal_bits(without->states().values(), prediction->states().values()), "what was sent counts");
  const MinimalPose start = {prediction->start.position_m[0], prediction->start.position_m[1], prediction->start.attitude_rad[2]};
  check(start.x_m > cruise(4, card).state.position_m[0] + 0.1, "further on than what was measured");
  double apart_m = 0.0;
  for (std::size_t i = 0; i < batch; ++i) {
    const MinimalPose pose = integrated(state, i, time - 1, start, 0.1);
    apart_m = std::max(apart_m, std::hypot(pose.x_m - prediction->states()(i, time - 1, 0), pose.y_m - prediction->states()(i, time - 1, 1)));
  }
  check(apart_m < 1e-4, "integrated " + std::to_string(apart_m) + " m apart");

  // What is kept for the age is not asked for; beyond it velocities go on. A measurement that is too old is a failure of the cycle.
  State longer = fresh(40);
  now_ns = newest_ns + 4 * grid_ns;
  model.predict(longer);
  check(!model.rollout().failure() && prediction->steps == 28 && prediction->rolled_forward_steps == 4, "as old as it may be");
  check(longer.vx(1, 39) == longer.vx(1, 27) && longer.vx(1, 27) != longer.vx(1, 26), "beyond the horizon");
  now_ns += grid_ns;
  model.predict(longer);
  check(model.rollout().failure() && model.rollout().failure()->code() == nesam::Code::failed_precondition &&
            model.rollout().failure()->field() == "start_stamp_ns" && longer.vx(1, 39) == longer.cvx(1, 38),
        "older than that: the commands are followed");
  options.fallback = nesam::KinematicFallback{card};
  Model falling(session, options);
  falling.predict(longer);
  check(falling.rollout().prediction() && falling.rollout().prediction()->computed_by == nesam::ComputedBy::kinematic_fallback &&
            falling.rollout().prediction()->start_stamp_ns == now_ns,
        "or the kinematics predict from now");

  // As it was where nobody says what time it is; and what `now` throws comes out.
  options = {};
  options.timeout = 30s;
  Model untimed(session, options);
  untimed.sent(newest_ns + grid_ns, 3.0, 0.3);
  untimed.predict(state);
  check(untimed.rollout().prediction() && untimed.rollout().prediction()->start_stamp_ns == newest_ns, "without `now` from the newest measurement");
  int thrown = 0;
  options.now = []() -> std::int64_t { throw std::runtime_error("no clock"); };
  Model clockless(session, options);
  try {
    clockless.predict(state);
  } catch (const std::runtime_error& error) {
    thrown += std::string(error.what()) == "no clock" ? 1 : 100;
  }
  options.age_max_s = 3.2;
  try {
    nesam::VelocityRollout(session, options);
  } catch (const nesam::Error& error) {
    thrown += error.field() == "age_max_s" ? 10 : 100;
  }
  check(thrown == 11, "what is thrown: " + std::to_string(thrown));
}

void service_motion_model_of_nav2(nesam::Client& client, const std::string& map_id) {
  nesam::OpenOptions options;
  options.vehicle_id = unique("nav2");
  options.map_id = map_id;
  const auto session = std::make_shared<nesam::Session>(std::move(client.open(options).value()));
  for (int step = 0; step < 5; ++step) (void)session->send(cruise(step, session->vehicle())).value();
  check_motion_model<false>(session, 0.1, true);
  check_motion_model<true>(session, 0.1, false);
  check_motion_model<true>(session, 0.05, true);

  // Longer than the service sees: the last velocities go on.
  MinimalState<true> state(1, 40);
  for (std::size_t j = 0; j < 40; ++j) state.cvx(0, j) = 1.0F;
  nesam::MotionModelOptions patient;
  patient.timeout = 30s;
  patient.failures_max = 2;
  nesam::RemoteMotionModel<MinimalMotionModel<true>, MinimalState<true>> model(session, patient);
  model.predict(state);
  check(state.vx(0, 39) == state.vx(0, 31) && state.vx(0, 31) != 0.0F, "beyond the horizon");

  // A service that does not answer: commands twice, then the planner is told.
  check(session->close().ok(), "close");
  int told = 0;
  for (int i = 0; i < 3; ++i) {
    try {
      model.predict(state);
      check(state.vx(0, 1) == 1.0F && model.rollout().failure() && model.rollout().failure()->code() == nesam::Code::not_found, "the commands are followed");
    } catch (const nesam::Error& error) {
      told += error.code() == nesam::Code::not_found ? 1 : 100;
    }
  }
  check(told == 1, "the third failure in a row is thrown");
  patient.model_dt_s = 0.03;
  bool refused = false;
  try {
    nesam::VelocityRollout(session, patient);
  } catch (const nesam::Error& error) {
    refused = error.field() == "model_dt_s";
  }
  check(refused, "a step that is no whole fraction");
}

void service_bad_predictions_are_refused(const nesam::Session& session, nesam::Client& client) {
  constexpr auto invalid = nesam::Code::invalid_argument;
  const nesam::VehicleCard& card = session.vehicle();
  const auto before = session.status();
  auto controls = varied_controls(3, 4, card);
  controls[(2 * 4 + 3) * 2] = nan_f;
  check_error(session.predict(request_of(controls, 3, 4)), invalid, "controls[2, 3]", "a control that is NaN");
  controls[(2 * 4 + 3) * 2] = static_cast<float>(card.speed_max_m_s + 1.0);
  check_error(session.predict(request_of(controls, 3, 4)), invalid, "controls[2, 3].speed_m_s", "a speed beyond the card");
  check_error(session.predict(request_of(controls, 3, 5)), invalid, "controls", "controls that do not fit their shape");
  nesam::PredictRequest three_channels;
  three_channels.controls = {nesam::Span<const float>(controls), 2, 4, 3};
  check_error(session.predict(three_channels), invalid, "controls", "three numbers for each command");
  const auto longer = varied_controls(2, 33, card);
  check_error(session.predict(request_of(longer, 2, 33)), invalid, "horizon", "K = 33");
  check_error(session.predict(request_of({}, 0, 0)), invalid, "samples", "N = 0");
  const auto wider = varied_controls(4097, 1, card);
  check_error(session.predict(request_of(wider, 4097, 1)), invalid, "samples", "N = 4097");
  const auto good = varied_controls(2, 8, card);
  nesam::PredictRequest request = request_of(good, 2, 8);
  request.stride = 9;
  check_error(session.predict(request), invalid, "output.stride", "a stride beyond the horizon");
  request = request_of(good, 2, 8);
  request.samples_min = 3;
  check_error(session.predict(request), invalid, "samples_min", "fewer than are there");
  request.samples_min = 1;
  const auto enough_time = session.predict(request);
  check(enough_time.ok() && enough_time->samples == 2, "all samples where there is time");
  request = request_of(good, 2, 8);
  request.channels = 1U << 12;
  check_error(session.predict(request), invalid, "output.channels", "an unknown channel");
  request = request_of(good, 2, 8);
  request.start = nesam::VehicleState{};
  request.start->position_m = {1000.0, 0.0, 0.0};
  check_error(session.predict(request), invalid, "start.position_m", "a start outside the map");
  request.start->position_m = {nan_d, 0.0, 0.0};
  check_error(session.predict(request), invalid, "start.position_m.x", "a start that is NaN");
  check_error(session.predict(request_of(good, 2, 8), 0ns), nesam::Code::deadline_exceeded, "", "no time at all");

  nesam::OpenOptions options;
  options.vehicle_id = unique("blank");
  auto blank = client.open(options);
  if (blank) {
    check_error(blank->predict(request_of(good, 2, 8)), nesam::Code::failed_precondition, "start", "neither start nor measurement");
    check(blank->close().ok(), "close");
    check_error(blank->predict(request_of(good, 2, 8)), nesam::Code::not_found, "session_id", "an unknown session");
  } else {
    check(false, blank.error().what());
  }
  const auto after = session.status();
  check(before.ok() && after.ok() && before->provenance.history_epoch == after->provenance.history_epoch, "the session is as it was");
}

void service_sessions_without_a_map(nesam::Client& client) {
  nesam::OpenOptions options;
  options.vehicle_id = unique("unmapped");
  auto session = client.open(options);
  check(session.ok(), session.ok() ? "" : session.error().what());
  if (!session) return;
  const auto controls = varied_controls(1, 8, session->vehicle());
  nesam::PredictRequest request = request_of(controls, 1, 8);
  request.start = nesam::VehicleState{};
  const auto prediction = session->predict(request);
  check(prediction.ok() && prediction->provenance.map_id.empty() && !prediction->measurement_age_s, prediction.ok() ? "no map" : prediction.error().what());
  check(prediction.ok() && (prediction->validity[0] & nesam::validity_no_map) != 0, "NO_MAP is said");
}

void service_threads_share_a_session(const nesam::Session& session) {
  const auto controls = varied_controls(4, 16, session.vehicle());
  const auto expected = session.predict(request_of(controls, 4, 16));
  check(expected.ok(), expected.ok() ? "" : expected.error().what());
  if (!expected) return;
  std::vector<int> right(4, 0);
  std::vector<std::thread> threads;
  for (int& count : right) {
    threads.emplace_back([&] {
      for (int i = 0; i < 5; ++i) {
        const auto prediction = session.predict(request_of(controls, 4, 16));
        count += prediction.ok() && equal_bits(prediction->states().values(), expected->states().values()) ? 1 : 0;
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  check(right == std::vector<int>(4, 5), "equal bits from four threads");
}

void service_nobody_listens() {
  // Port 1 is reserved and not served on a usual machine.
  nesam::Client client("127.0.0.1:1");
  check_error(client.sessions(2s), nesam::Code::unavailable, "", "a call");
  check_error(client.connect(50ms), nesam::Code::deadline_exceeded, "", "a connection");
  bool thrown = false;
  try {
    (void)client.sessions(2s).value();
  } catch (const nesam::Error& error) {
    thrown = error.code() == nesam::Code::unavailable && error.retryable();
  }
  check(thrown, "value() throws the error in this thread");
}

void run_all(nesam::Client& client) {
  run("analytic_views_index_row_major", analytic_views_index_row_major);
  run("analytic_channels_have_columns", analytic_channels_have_columns);
  run("analytic_commands_ask_for_a_twist", analytic_commands_ask_for_a_twist);
  run("service_nobody_listens", service_nobody_listens);
  run("service_maps", [&] { service_maps(client); });
  run("service_sessions_are_raii", [&] { service_sessions_are_raii(client); });
  const FlatMap flat;
  const std::string map_id = unique("ground");
  client.upload_map(flat.view(map_id, 1)).value();
  {
    nesam::OpenOptions options;
    options.vehicle_id = unique("truck");
    options.map_id = map_id;
    nesam::Session session = std::move(client.open(options).value());
    run("service_measurements_get_typed_answers", [&] { service_measurements_get_typed_answers(session); });
    run("service_predictions", [&] { service_predictions(session, map_id); });
    run("service_bad_predictions_are_refused", [&] { service_bad_predictions_are_refused(session, client); });
    run("service_the_service_draws_and_ranks", [&] { service_the_service_draws_and_ranks(session); });
    run("service_motion_model_of_nav2", [&] { service_motion_model_of_nav2(client, map_id); });
    run("service_motion_model_from_now", [&] { service_motion_model_from_now(client, map_id); });
    run("service_threads_share_a_session", [&] { service_threads_share_a_session(session); });
  }
  client.delete_map(map_id).value();
  run("service_sessions_without_a_map", [&] { service_sessions_without_a_map(client); });
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
