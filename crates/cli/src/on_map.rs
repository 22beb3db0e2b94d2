//! Whether drives are where their maps are.

use nesam_physics::Vehicle;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

/// Heights of a vehicle that follows its map spread less than this about their mean, m (chosen; the simulated drives have 0.03).
const HEIGHT_SPREAD_M: f64 = 0.5;
/// Ground whose heights deviate from their mean by this says something of whether others follow it, m (chosen: five times the noise of the simulated drives).
const GROUND_VARIES_M: f64 = 0.1;
/// Share of their own deviation by which heights deviate from a map that they do not follow (chosen: 0.33 at most of the simulated drives on their maps, on soft soil).
const UNRELATED: f64 = 0.8;
/// Their mean is that of a vehicle that stands on the map, but for this, m (chosen: what a prediction calls a start off the ground).
const HEIGHT_OFF_M: f64 = 0.5;

/// What speaks against this map under those of the drives that name it.
pub fn doubts(drives: &[Trajectory], world: &str, map: &WorldMap, vehicle: &Vehicle) -> Vec<String> {
    let there = drives.iter().filter(|d| d.world.as_deref() == Some(world)).flat_map(|d| &d.states);
    let (mut heights, mut grounds, mut outside): (Vec<f64>, Vec<f64>, usize) = (Vec::new(), Vec::new(), 0);
    for [x, y, z] in there.map(|s| s.position_m) {
        match map.height_m(x, y) {
            Some(ground) => {
                heights.push(z);
                grounds.push(ground);
            }
            None => outside += 1,
        }
    }
    let above: Vec<f64> = heights.iter().zip(&grounds).map(|(z, ground)| z - ground).collect();
    let (mean, spread) = mean_and_spread(&above);
    let (of_heights, of_ground) = (mean_and_spread(&heights).1, mean_and_spread(&grounds).1);
    // On another place of the same gentle ground both vary, and the one takes nothing from the other.
    let unrelated = of_ground > GROUND_VARIES_M && spread >= UNRELATED * of_heights;
    let stands = vehicle.standing_height_m();
    let mut found = Vec::new();
    if outside * 10 > above.len() {
        let all = outside + above.len();
        found.push(format!("{outside} of {all} positions lie off map {world} or in its holes; is it of this place, in this frame?"));
    }
    if spread > HEIGHT_SPREAD_M || unrelated {
        found.push(format!(
            "heights do not follow map {world}: {mean:.2} ± {spread:.2} m above it, and ± {of_heights:.2} m by themselves; is it of this place, in this frame?"
        ));
    } else if !above.is_empty() && (mean - stands).abs() > HEIGHT_OFF_M {
        let side = if mean > stands { "above" } else { "below" };
        found.push(format!(
            "positions are {:.2} m {side} where the vehicle stands on map {world} ({mean:.2} m above it, by its card {stands:.2} m): is one of the two an \
             ellipsoidal height and the other one above the sea, or the position that of an antenna? Every prediction begins in the air or in the ground",
            (mean - stands).abs()
        ));
    }
    found
}

/// Mean of heights and deviation from it, m; zero of none.
fn mean_and_spread(heights_m: &[f64]) -> (f64, f64) {
    let count = heights_m.len().max(1) as f64;
    let mean = heights_m.iter().sum::<f64>() / count;
    (mean, (heights_m.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / count).sqrt())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::args::DataArgs;
    use crate::sources::read_drives;

    /// Goal: a log of another height than its map is doubted, and one of the same height is not. Method: recorded drives, and the same moved.
    #[test]
    fn regress_a_height_of_another_datum_is_doubted() {
        let drives = read_drives(&DataArgs::of(None), false).expect("the shipped sample");
        let vehicle = drives.root.vehicle();
        for (drive, map) in drives.drives.iter().zip(&drives.maps) {
            let map: &Arc<WorldMap> = map.as_ref().expect("the sample has maps");
            let told = |by_m: f64| {
                let mut moved = drive.clone();
                moved.states.iter_mut().for_each(|state| state.position_m[2] += by_m);
                doubts(&[moved], map.id(), map, vehicle)
            };
            assert_eq!(told(0.0), [""; 0]);
            for (by_m, side) in [(1.0, "above"), (-1.0, "below"), (40.0, "above")] {
                let told = told(by_m);
                assert!(told.len() == 1 && told[0].contains(side) && told[0].contains("ellipsoidal"), "{told:?}");
            }
        }
    }

    /// Goal: a map of another frame is doubted on gentle ground too. Method: recorded drives on ground of 0.3 m, x and y swapped and moved by 6 m.
    #[test]
    fn regress_a_map_of_another_frame_is_doubted_on_gentle_ground() {
        let drives = read_drives(&DataArgs::of(None), false).expect("the shipped sample");
        let vehicle = drives.root.vehicle();
        let (there, maps): (Vec<Trajectory>, Vec<_>) =
            drives.drives.iter().cloned().zip(&drives.maps).filter(|(drive, _)| drive.world.as_deref() == Some("w01")).unzip();
        let map: &Arc<WorldMap> = maps[0].as_ref().expect("the sample has maps");
        let told = |change: fn([f64; 3]) -> [f64; 3]| {
            let mut moved = there.clone();
            moved.iter_mut().flat_map(|drive| &mut drive.states).for_each(|state| state.position_m = change(state.position_m));
            doubts(&moved, map.id(), map, vehicle)
        };
        assert_eq!(told(|position_m| position_m), [""; 0]);
        for told in [told(|[x, y, z]| [y, x, z]), told(|[x, y, z]| [x + 6.0, y, z])] {
            assert!(told.len() == 1 && told[0].contains("heights do not follow map w01"), "{told:?}");
        }
    }
}
