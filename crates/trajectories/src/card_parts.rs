//! What the parts that a vehicle card states weigh together. Nothing is computed with it: it says whether the mass of the whole can be right.

use std::path::Path;

use nesam_physics::WHEELS;

use crate::json::JsonFile;

/// Parts of one wheel, where the card does not state what they weigh together.
const OF_WHEEL: [&str; 4] = ["tyre.mass", "wheel.mass", "hub_spindle.mass", "upright.mass"];

/// Mass of the chassis and of four wheels, as far as the card states them, kg; `None` where it states none.
pub fn mass_of_parts_kg(card: &Path) -> Option<f64> {
    let sheet = JsonFile::read(card).ok()?;
    let stated = |key: &str| sheet.number(&[key]).ok().flatten();
    let per_wheel = stated("unsprung_mass_per_wheel").or_else(|| OF_WHEEL.into_iter().filter_map(stated).reduce(|a, b| a + b));
    let wheels = per_wheel.map(|each| WHEELS as f64 * each);
    [stated("mass_sprung_chassis"), wheels].into_iter().flatten().reduce(|a, b| a + b)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: parts are added up under the names of cards. Method: a card that states chassis and wheels, one with the parts of a wheel, one without any.
    #[test]
    fn analytic_parts_of_cards_add_up() {
        let here = tempfile::tempdir().unwrap();
        let of = |card: &str| {
            let path = here.path().join("vehicle_test.json");
            std::fs::write(&path, card).unwrap();
            mass_of_parts_kg(&path)
        };
        assert_eq!(of(r#"{"mass_sprung_chassis": 80, "unsprung_mass_per_wheel": 4, "tyre": {"mass": 1}}"#), Some(96.0));
        assert_eq!(of(r#"{"tyre": {"mass": 1.5}, "wheel": {"mass": 0.5}}"#), Some(8.0));
        assert_eq!(of(r#"{"mass_sprung_chassis": 80}"#), Some(80.0));
        assert_eq!(of(r#"{"mass_total": 80, "tyre": {"radius": 0.3}, "wheel": "of steel"}"#), None);
    }
}
