// Goal: copies of sessions, effects, alarms and changed maps do what the service says of them.
// Method: a session that has learned of its soil, its fork, its export and import must predict with the same bits; effects must come back as they were put on
// and change predictions until they are taken away; sensors that contradict each other must raise one alarm, which effects end; a patched tile must move
// predictions.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "check.hpp"
#include "scenario.hpp"

namespace {

using namespace std::chrono_literals;

/// A session that has learned something of its soil.
nesam::Session learned(nesam::Client& client, const std::string& name, const std::string& map_id) {
  nesam::Session session = driven(client, name, map_id);
  for (const nesam::Measurement& measurement : predicted_drive(session)) (void)session.send(measurement).value();
  return session;
}

/// What a session predicts now.
std::vector<float> states(const nesam::Session& session) {
  constexpr std::size_t samples = 3, horizon = 16;
  const auto controls = varied_controls(samples, horizon, session.vehicle());
  return predicted(session, request_of(controls, samples, horizon)).value().states_storage;
}

/// Where the vehicle is after the drive of `learned`, and a step further.
nesam::Measurement next_measurement(const nesam::Session& session) {
  nesam::Measurement measurement = cruise(5 + static_cast<int>(nesam::horizon_max), session.vehicle());
  measurement.state = session.status().value().state.value();
  return measurement;
}

void service_the_status_tells_all(nesam::Session& session) {
  nesam::Measurement measurement = next_measurement(session);
  measurement.boot_id = 17;
  measurement.stamp_ns += grid_ns;
  ++measurement.sequence;
  const auto answer = session.send(measurement);
  const auto status = session.status();
  if (!check_ok(answer, "measurement") || !check_ok(status, "status")) return;
  check(answer->place == 39 && answer->durable_place == 0, "place 39; without a store nothing is durable");
  check(answer->run != 0 && answer->run == status->run && status->accepted == 39 && status->durable_place == 0, "run and accepted");
  check(answer->soil_correction && answer->soil_correction->delta.k_phi == status->soil_correction.delta.k_phi, "the answer has the soil");
  check(status->boot_id == 17 && !status->vehicle_alive && status->effects.empty() && status->effects_source.empty() && !status->alarm, "the rest");
  measurement.stamp_ns += grid_ns;
  ++measurement.sequence;
  measurement.run = answer->run + 1;
  const auto refused = session.send(measurement);
  const auto* rejected = refused.ok() ? refused->is<nesam::Rejected>() : nullptr;
  check(rejected && rejected->code == nesam::Code::failed_precondition && rejected->field == "run", "a measurement for another run");
  check(refused.ok() && refused->place == 0 && !refused->soil_correction, "has neither place nor soil");
}

void service_forks_go_their_own_way(nesam::Client& client, nesam::Session& session) {
  const std::string name = unique("what-if");
  auto fork = session.fork(name);
  if (!check_ok(fork, "fork")) return;
  const auto original = session.status().value(), copy = fork->status().value();
  check(fork->id() == name && copy.vehicle_id == original.vehicle_id && copy.provenance.soil_epoch == original.provenance.soil_epoch, "the same vehicle");
  check(original.provenance.soil_epoch > 0 && equal_bits(states(*fork), states(session)), "the same bits, with what was learned");
  check_ok(fork->send(next_measurement(*fork)), "a measurement into the copy");
  check(session.status().value().provenance.history_epoch == original.provenance.history_epoch, "leaves the original alone");
  check(!equal_bits(states(*fork), states(session)), "and moves the copy");
  check_error(session.fork(name), nesam::Code::already_exists, "new_session_id", "the same name again");
  check_error(session.fork("not/a/name"), nesam::Code::invalid_argument, "new_session_id", "a bad name");
  check_ok(fork->close(), "close");
  check_error(fork->fork(unique("again")), nesam::Code::not_found, "session_id", "a fork of a closed session");
  {
    const auto gone = session.fork(name);
    check_ok(gone, "the name is free again");
  }
  check_error(client.session(name), nesam::Code::not_found, "session_id", "a copy closes when its object goes");
}

void service_exports_are_imported_bit_for_bit(nesam::Client& client, nesam::Session& session) {
  const auto image = session.export_image();
  // Ages since the newest measurement are in it: no two have the same bytes.
  const auto by_name = client.export_session(session.id());
  if (!check_ok(image, "export") || !check_ok(by_name, "export by name")) return;
  check_error(client.import_session(*image), nesam::Code::already_exists, "session_id", "under its own name, which is open");
  const std::string name = unique("imported");
  auto imported = client.import_session(*image, name);
  if (!check_ok(imported, "import")) return;
  check(imported->id() == name && equal_bits(states(*imported), states(session)), "the same bits");
  // Both go on alike.
  const nesam::Measurement measurement = next_measurement(session);
  auto beside = client.import_session(*by_name, unique("beside"));
  if (!check_ok(beside, "import of the export by name")) return;
  const auto first = imported->send(measurement), second = beside->send(measurement), original = session.send(measurement);
  check(first.ok() && second.ok() && original.ok() && first->outcome.index() == original->outcome.index(), "the same answer");
  check(equal_bits(states(*imported), states(session)) && equal_bits(states(*beside), states(session)), "and go on alike");

  std::string damaged = *image;
  damaged[damaged.size() / 2] = static_cast<char>(damaged[damaged.size() / 2] ^ 1);
  check_error(client.import_session(damaged, unique("damaged")), nesam::Code::invalid_argument, "image", "a damaged image");
  check_error(client.import_session(image->substr(0, image->size() / 2), unique("cut")), nesam::Code::invalid_argument, "image", "half an image");
  check_error(client.import_session("", unique("empty")), nesam::Code::invalid_argument, "image", "no image");
  check_error(client.import_session(*image, "not/a/name"), nesam::Code::invalid_argument, "session_id", "a bad name");
  check_ok(imported->close(), "close");
  check_error(imported->export_image(), nesam::Code::not_found, "session_id", "exporting a closed session");
}

void service_effects_act_until_reverted(nesam::Client& client, const std::string& map_id) {
  nesam::Session session = learned(client, "loaded", map_id);
  // A copy of it, for what must not change.
  const nesam::Session plain = std::move(session.fork(unique("plain")).value());
  const auto before = states(session);
  const nesam::Effect payload = {"payload", {{"mass_kg", 300.0, 0.0}, {"x_m", -1.0, 0.0}, {"y_m", 0.0, 0.0}, {"z_m", 0.5, 0.0}}};
  const std::vector<nesam::Effect> effects = {{"steering_offset", {{"second", 0.1, 0.02}}}, payload};
  const auto applied = session.apply_effects(effects, "a test");
  if (!check_ok(applied, "apply")) return;
  check(applied->effects.size() == 2 && applied->effects_source == "a test", "effects and source");
  const nesam::Effect& offset = applied->effects.at(0);
  check(offset.id == "steering_offset" && offset.parameters.size() == 1 && offset.parameters[0].name == "second", "id and name");
  check(offset.parameters[0].value == 0.1 && offset.parameters[0].sd == 0.02 && applied->effects[1].parameters.size() == 4, "value and standard deviation");
  check(applied->soil_correction.delta.k_phi == 0.0 && applied->provenance.soil_epoch > plain.status().value().provenance.soil_epoch, "the soil begins again");
  check(!equal_bits(states(session), before) && equal_bits(states(plain), before), "this session predicts otherwise, its copy as before");
  const auto read = session.status();
  check(read.ok() && read->effects.size() == 2 && read->effects_source == "a test", "read again");

  const auto wrong = [&](const nesam::Effect& effect) { return session.apply_effects({effect}); };
  constexpr auto invalid = nesam::Code::invalid_argument;
  check_error(session.apply_effects({}), invalid, "effects", "none");
  check_error(wrong({"ghost", {}}), invalid, "effects[0]", "unknown");
  check_error(wrong({"steering_offset", {{"second", 7.0, 0.0}}}), invalid, "effects[0]", "out of range");
  check_error(session.apply_effects(effects, std::string(257, 'x')), invalid, "source", "a long source");
  check(session.status().value().effects.size() == 2, "what was refused changed nothing");

  const auto reverted = session.revert_effects();
  check(reverted.ok() && reverted->effects.empty() && reverted->effects_source.empty(), reverted.ok() ? "reverted" : reverted.error().what());
  check_ok(session.revert_effects(), "without effects nothing happens");
  check_ok(session.close(), "close");
  check_error(session.apply_effects(effects), nesam::Code::not_found, "session_id", "a closed session");
  check_error(session.revert_effects(), nesam::Code::not_found, "session_id", "a closed session");
}

void service_predictions_are_held_against_what_came(nesam::Client& client, const std::string& map_id) {
  nesam::Session session = driven(client, "held", map_id);
  const auto before = session.status();
  check(before.ok() && !before->forecasts, "nothing came true yet");
  // The first one that is compared begins at the 32nd step and comes true 32 steps later.
  for (int step = 5; step < 75; ++step) check_ok(session.send(cruise(step, session.vehicle())), "measurement");
  const auto status = session.status();
  check(status.ok() && status->forecasts, "one came true");
  if (!status.ok() || !status->forecasts) return;
  const nesam::ForecastCheck& told = *status->forecasts;
  check(told.checked == 1 && told.error_rms_m.size() == 3 && told.expected_rms_m.size() == 3, "at three steps");
  check(told.error_rms_m.back() > 0.0 && told.expected_rms_m.back() > 0.0 && told.scale >= 0.5 && told.height_scale >= 0.5, "errors and what was expected");
  check_ok(session.close(), "close");
}

void service_alarms_are_watched(nesam::Client& client, const std::string& map_id) {
  nesam::Session session = driven(client, "alarmed", map_id);
  nesam::AlarmWatch watch = session.watch_alarms();
  check_error(watch.receive(20ms), nesam::Code::deadline_exceeded, "", "nothing to tell");
  // The vehicle moves by 0.1 m a step and says that it drives at 0.7 m/s: after the first buffer of a second the sensors contradict each other by 0.3 m/s.
  for (int step = 5; step < 40; ++step) {
    nesam::Measurement measurement = cruise(step, session.vehicle());
    measurement.state.velocity_m_s[0] = 0.7;
    check_ok(session.send(measurement), "measurement");
  }
  const auto raised = watch.receive(30s);
  if (!check_ok(raised, "an alarm")) return;
  check(raised->active && raised->episode == 1 && raised->session_id == session.id() && raised->vehicle_id == session.id(), "raised for this session");
  check(raised->kind == nesam::AlarmKind::sensor_jump && raised->channel == "path_minus_velocity_ahead_m_s", "sensors: " + raised->channel);
  // The mean over a buffer that may begin before the contradiction does.
  check(raised->size > 0.1 && raised->size < 0.4, "by " + std::to_string(raised->size) + " m/s");
  check(raised->statistic > raised->threshold && raised->threshold > 0.0, "over the threshold");
  check(raised->onset_stamp_ns < raised->stamp_ns && raised->soil_share >= 0.0 && raised->soil_share <= 1.0, "stamps and share");
  check(!raised->description.empty() && raised->diagnose.find("nesam diagnose") == 0, "what to do: " + raised->diagnose);
  const auto status = session.status();
  check(status.ok() && status->alarm && status->alarm->episode == 1 && status->alarm->statistic == raised->statistic, "the session tells it too");

  // Who comes late hears the active one first; another vehicle begins without an alarm.
  nesam::AlarmWatch late = session.watch_alarms();
  const auto present = late.receive(30s);
  check(present.ok() && present->active && present->stamp_ns == raised->stamp_ns, "the active one comes first");
  const auto applied = session.apply_effects({{"velocity_scale", {{"relative", -0.3, 0.0}}}}, "the alarm");
  check(applied.ok() && !applied->alarm, applied.ok() ? "an effect ends it" : applied.error().what());
  for (nesam::AlarmWatch* one : {&watch, &late}) {
    const auto cleared = one->receive(30s);
    check(cleared.ok() && !cleared->active && cleared->episode == 1, "cleared");
  }
  check_ok(session.close(), "close");
  check_error(watch.receive(30s), nesam::Code::not_found, "session_id", "the session was closed");
  late = session.watch_alarms();
  check_error(late.receive(30s), nesam::Code::not_found, "session_id", "an unknown session");
}

void service_tiles_are_patched(nesam::Client& client) {
  const FlatMap flat;
  const std::string id = unique("patched");
  const auto first = client.upload_map(flat.view(id, 1)).value();
  check(client.map(id).value().hash == first.hash, "the map is described");
  {
    const nesam::Session session = driven(client, "patcher", id);
    const auto before = states(session);
    // A ramp under and before the vehicle.
    std::vector<float> elevation_m;
    nesam::MapTile tile{35, 38, 10, 24, {}, {}};
    for (std::size_t i = 0; i < std::size_t{tile.rows} * tile.columns; ++i) elevation_m.push_back(0.05F * static_cast<float>(i % tile.columns));
    tile.elevation_m = nesam::Span<const float>(elevation_m);
    const auto patched = client.patch_tile(id, 1, tile);
    if (!check_ok(patched, "patch")) return;
    check(patched->version == 2 && patched->hash != first.hash && patched->semantic && patched->geometry.width == FlatMap::side, "the next version");
    check(client.map(id).value().hash == patched->hash, "is the one that is there");
    check(!equal_bits(states(session), before) && session.status().value().provenance.map_version == 2, "sessions drive on it");
    check_error(client.patch_tile(id, 1, tile), nesam::Code::aborted, "base_version", "a patch of the version before");
    check_error(client.patch_tile("no-such-map", 1, tile), nesam::Code::not_found, "map_id", "an unknown map");
    tile.row = FlatMap::side - 5;
    check_error(client.patch_tile(id, 2, tile), nesam::Code::invalid_argument, "tile.rows", "beyond the edge");
    tile.rows = 9;
    check_error(client.patch_tile(id, 2, tile), nesam::Code::invalid_argument, "elevation_m", "a layer too large for its tile");
    tile = {0, 0, 10, 24, nesam::Span<const float>(elevation_m), nesam::Span<const std::uint8_t>(flat.rgb)};
    check_error(client.patch_tile(id, 2, tile), nesam::Code::invalid_argument, "semantic_rgb", "colours too many for their tile");
    tile.semantic_rgb = nesam::Span<const std::uint8_t>(flat.rgb).subspan(0, 3 * elevation_m.size());
    check(client.patch_tile(id, 2, tile).value().version == 3, "with colours");
  }
  client.delete_map(id).value();
  check_error(client.map(id), nesam::Code::not_found, "map_id", "an unknown map");
}

void run_all(nesam::Client& client) {
  const HillyMap hills;
  const std::string map_id = unique("hills");
  client.upload_map(hills.view(map_id, 1)).value();
  {
    nesam::Session session = learned(client, "original", map_id);
    run("service_forks_go_their_own_way", [&] { service_forks_go_their_own_way(client, session); });
    run("service_exports_are_imported_bit_for_bit", [&] { service_exports_are_imported_bit_for_bit(client, session); });
    run("service_the_status_tells_all", [&] { service_the_status_tells_all(session); });
  }
  run("service_effects_act_until_reverted", [&] { service_effects_act_until_reverted(client, map_id); });
  run("service_predictions_are_held_against_what_came", [&] { service_predictions_are_held_against_what_came(client, map_id); });
  run("service_alarms_are_watched", [&] { service_alarms_are_watched(client, map_id); });
  run("service_tiles_are_patched", [&] { service_tiles_are_patched(client); });
  run("service_there_is_no_soil_map_by_default",
      [&] { check_error(client.fleet_soil(map_id), nesam::Code::failed_precondition, "map_id", "a service without a map of the soil"); });
  run("service_what_is_not_recorded_is_not_diagnosed", [&] {
    nesam::DiagnosisRequest request;
    request.session_id = "anybody";
    check_error(client.diagnose(request).receive(30s), nesam::Code::failed_precondition, "recording", "a service that records nothing");
    request.from_stamp_ns = 2;
    request.to_stamp_ns = 1;
    nesam::Diagnosis diagnosis = client.diagnose(request);
    for (int i = 0; i < 2; ++i) check_error(diagnosis.receive(30s), nesam::Code::invalid_argument, "to_stamp_ns", "a window that ends before it begins");
  });
  client.delete_map(map_id).value();
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
