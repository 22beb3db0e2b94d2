//! Ground that is not what it looks like, made from drives on ordinary ground: how an adaptation is judged without a test set.

use crate::{SoilClassRange, WorldMap};

/// How the semantic image is repainted. The drives stay as they were measured, so soil prior and network believe in another class than the one driven on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Disguise {
    /// Every class looks like the next firmer one: all ground is softer than it looks.
    Firmer,
    /// Every class looks like the next softer one.
    Softer,
    /// Each class looks like the next softer one, like itself or like the next firmer one: digit i of this number in base 3, lowest first, says which of the three for
    /// the class that is i-th in firmness. Digits beyond the number's length are 0.
    Mixed(u64),
}

/// Brightness of a pixel against its palette colour that shading and texture may explain.
const SHADE: [f64; 2] = [0.75, 1.25];
/// Squared colour distance that a brightness of 0 or 2 costs (chosen): a palette colour of its own brightness goes before a shaded neighbour.
const SHADE_PENALTY: f64 = 400.0;

impl Disguise {
    /// The map in disguise; `None` without semantics or with fewer than two classes of known colour.
    pub fn of(self, map: &WorldMap) -> Option<WorldMap> {
        let mut classes: Vec<(&SoilClassRange, [f64; 3])> =
            map.soil_classes().iter().filter_map(|class| class.colour.map(|rgb| (class, rgb.map(f64::from)))).collect();
        if classes.len() < 2 {
            return None;
        }
        // Firmness = the middle of the range of k_phi.
        classes.sort_by(|(a, _), (b, _)| (a.low[0] * a.high[0]).total_cmp(&(b.low[0] * b.high[0])));
        let last = classes.len() - 1;
        let steps_up = |class: usize| match self {
            Self::Firmer => 2,
            Self::Softer => 0,
            Self::Mixed(digits) => digits / 3u64.saturating_pow(class as u32) % 3,
        };
        let looks_like = |class: usize| (class + steps_up(class) as usize).saturating_sub(1).min(last);
        let painted = |pixel: [u8; 3]| {
            let pixel = pixel.map(f64::from);
            let (class, shade) = classify(&classes, pixel);
            let (from, to) = (classes[class].1, classes[looks_like(class)].1);
            std::array::from_fn(|i| (pixel[i] + shade * (to[i] - from[i])).round().clamp(0.0, 255.0) as u8)
        };
        let semantics = map.semantic_rgb()?.into_iter().map(painted).collect();
        let look = match self {
            Self::Firmer => "firmer".into(),
            Self::Softer => "softer".into(),
            Self::Mixed(digits) => format!("mixed {digits}"),
        };
        let id = format!("{} as if {look}", map.id());
        let repainted = WorldMap::from_layers(&id, map.version(), *map.geometry(), map.elevation_m(), Some(semantics)).ok()?;
        Some(repainted.with_soil_classes(map.soil_classes().to_vec()))
    }
}

/// Class and brightness that come closest to a pixel.
fn classify(classes: &[(&SoilClassRange, [f64; 3])], pixel: [f64; 3]) -> (usize, f64) {
    let mut best = (f64::INFINITY, 0, 1.0);
    for (class, (_, colour)) in classes.iter().enumerate() {
        let dot = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let shade = (dot(&pixel, colour) / dot(colour, colour).max(1.0)).clamp(SHADE[0], SHADE[1]);
        let away: f64 = (0..3).map(|i| (pixel[i] - shade * colour[i]).powi(2)).sum();
        let distance = away + SHADE_PENALTY * (shade - 1.0).powi(2);
        if distance < best.0 {
            best = (distance, class, shade);
        }
    }
    (best.1, best.2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::GridGeometry;

    #[test]
    fn analytic_every_class_takes_the_colour_of_its_neighbour_and_keeps_its_shade() {
        let class = |name: &str, colour, k_phi: f64| SoilClassRange {
            name: name.into(),
            colour: Some(colour),
            low: [k_phi, 1.0, 1.0, 1.0, 0.5, 0.02],
            high: [k_phi + k_phi, 1.0, 1.0, 1.0, 0.5, 0.02],
        };
        let (mud, sand, grass) = ([84, 68, 52], [200, 180, 140], [88, 122, 52]);
        let shaded = sand.map(|v: u8| (f64::from(v) * 0.9).round() as u8);
        let geometry = GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width: 2, height: 2 };
        let map = WorldMap::from_layers("m", 1, geometry, vec![0.0; 4], Some(vec![mud, sand, grass, shaded])).unwrap();
        assert!(Disguise::Firmer.of(&map).is_none(), "no classes, no disguise");
        let map = map.with_soil_classes(vec![class("sand", sand, 1e6), class("grass", grass, 3e6), class("mud", mud, 3e5)]);
        let of = |disguise: Disguise| disguise.of(&map).unwrap().semantic_rgb().unwrap();
        assert_eq!(of(Disguise::Firmer)[..3], [sand, grass, grass]);
        assert_eq!(of(Disguise::Softer)[..3], [mud, mud, sand]);
        // Mud stays (1), sand looks softer (0), grass softer (0); and mud firmer (2), sand itself (1), grass firmer, which there is nothing to be.
        assert_eq!(of(Disguise::Mixed(1))[..3], [mud, mud, sand]);
        assert_eq!(of(Disguise::Mixed(2 + 3 + 18))[..3], [sand, sand, grass]);
        for (found, wanted) in of(Disguise::Firmer)[3].into_iter().zip(grass) {
            assert!((f64::from(found) - 0.9 * f64::from(wanted)).abs() < 3.0, "{found} {wanted}");
        }
    }
}
