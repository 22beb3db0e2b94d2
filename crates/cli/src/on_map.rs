//! Whether drives are where their maps are.

use nesam_physics::Vehicle;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

/// Heights of a vehicle that follows its map spread less than this about their mean, m (chosen; the simulated drives have 0.03).
const HEIGHT_SPREAD_M: f64 = 0.5;
/// Their mean is that of a vehicle that stands on the map, but for this, m (chosen: what a prediction calls a start off the ground).
const HEIGHT_OFF_M: f64 = 0.5;

/// What speaks against this map under those of the drives that name it.
pub fn doubts(drives: &[Trajectory], world: &str, map: &WorldMap, vehicle: &Vehicle) -> Vec<String> {
    let there = drives.iter().filter(|d| d.world.as_deref() == Some(world)).flat_map(|d| &d.states);
    let (mut above, mut outside): (Vec<f64>, usize) = (Vec::new(), 0);
    for [x, y, z] in there.map(|s| s.position_m) {
        match map.height_m(x, y) {
            Some(ground) => above.push(z - ground),
            None => outside += 1,
        }
    }
    let count = above.len().max(1) as f64;
    let mean = above.iter().sum::<f64>() / count;
    let spread = (above.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / count).sqrt();
    let stands = vehicle.standing_height_m();
    let mut found = Vec::new();
    if outside * 10 > above.len() {
        let all = outside + above.len();
        found.push(format!("{outside} of {all} positions lie off map {world} or in its holes; is it of this place, in this frame?"));
    }
    if spread > HEIGHT_SPREAD_M {
        found.push(format!("heights do not follow map {world}: {mean:.2} ± {spread:.2} m above it; is it of this place, in this frame?"));
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
}
