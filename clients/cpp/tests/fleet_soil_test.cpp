// Goal: what the fleet has learned of the ground is read, and it is what sessions have learned.
// Method: a server that keeps such a map (`fleet_soil.enabled`); one session drives, another one begins where it was.
//
// Usage and exit codes: check.hpp.

#include <nesam/nesam.hpp>

#include <cmath>
#include <cstddef>
#include <string>
#include <utility>

#include "check.hpp"
#include "scenario.hpp"

namespace {

void service_the_fleet_learns_the_ground(nesam::Client& client, const std::string& map_id) {
  const auto before = client.fleet_soil(map_id);
  check(before.ok() && before->cells.empty() && before->cell_m > 0.0, before.ok() ? "nothing yet" : before.error().what());
  nesam::Session session = driven(client, "scout", map_id);
  for (const nesam::Measurement& measurement : predicted_drive(session)) (void)session.send(measurement).value();
  const auto map = client.fleet_soil(map_id);
  if (!check_ok(map, "the map") || map->cells.empty()) return check(false, "the drive has brought no evidence");
  for (const nesam::FleetSoilCell& cell : map->cells) {
    check(cell.map_id == map_id && cell.buffers > 0.0 && cell.age_s >= 0.0, "map, buffers and age");
    // The map is of one grey, 120 of each colour, in steps of 16 levels; the drive begins at the origin and takes some metres.
    check((cell.colour_rgb >> 16) / 16 == 120 / 16 && std::abs(cell.column) <= 2 && std::abs(cell.row) <= 2, "colour and place");
    bool symmetric = true, positive = false;
    for (std::size_t i = 0; i < 6; ++i) {
      for (std::size_t j = 0; j < 6; ++j) symmetric = symmetric && std::abs(cell.information[i][j] - cell.information[j][i]) <= 1e-9 * cell.information[i][i];
      positive = positive || cell.information[i][i] > 0.0;
    }
    check(symmetric && positive && std::isfinite(cell.vector.k_phi), "information");
  }
  const auto all = client.fleet_soil();
  check(all.ok() && all->cells.size() == map->cells.size(), "an empty name means all maps");
  check(client.fleet_soil("no-such-map").value().cells.empty(), "nothing is known of another map");
  // Who begins on this ground knows what the other one has learned.
  nesam::Session second = driven(client, "follower", map_id);
  const auto status = second.status();
  check(status.ok() && status->soil_correction.delta.k_phi != 0.0, "a second session begins with it");
}

void run_all(nesam::Client& client) {
  const HillyMap hills;
  const std::string map_id = unique("hills");
  client.upload_map(hills.view(map_id, 1)).value();
  run("service_the_fleet_learns_the_ground", [&] { service_the_fleet_learns_the_ground(client, map_id); });
  client.delete_map(map_id).value();
}

}  // namespace

int main(int argc, char** argv) { return run_against_server(argc, argv, run_all); }
