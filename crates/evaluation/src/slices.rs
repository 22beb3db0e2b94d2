//! Slices: the same errors apart by where and how the vehicle drove, so that a mean hides nothing.

use std::collections::BTreeSet;
use std::sync::Arc;

use nesam_physics::wrap_angle;
use nesam_terrain::WorldMap;

use crate::bootstrap::quantile_sorted;
use crate::windows::Window;

/// A named subset of the windows.
#[derive(Clone, Debug, PartialEq)]
pub struct Slice {
    /// Key in JSON and first column of the table.
    pub name: String,
    /// Whether each window belongs to it.
    pub member: Vec<bool>,
}

impl Slice {
    /// Number of windows in the slice.
    pub fn windows(&self) -> usize {
        self.member.iter().filter(|m| **m).count()
    }
}

/// Slices by world (seen in training or new), by semantic class under the start, and by terciles of speed, turning, relief and slip over the
/// windows given. `training_worlds` is empty when it is not known which worlds were trained on; then no slice is made by world. `maps`: one
/// per drive. What the data do not tell (classes, wheel speeds) gives no slice.
pub fn slices(
    windows: &[Window<'_>],
    maps: &[Option<Arc<WorldMap>>],
    wheel_radius_m: f64,
    training_worlds: &BTreeSet<String>,
) -> Vec<Slice> {
    let mut out = Vec::new();
    if !training_worlds.is_empty() {
        let seen = |w: &Window<'_>| w.trajectory.world.as_ref().is_some_and(|world| training_worlds.contains(world));
        let member: Vec<bool> = windows.iter().map(seen).collect();
        out.push(Slice { name: "world_new".into(), member: member.iter().map(|m| !m).collect() });
        out.push(Slice { name: "world_seen_in_training".into(), member });
    }
    let classes: Vec<Option<String>> = windows.iter().map(|w| class_at_start(w, maps)).collect();
    for name in classes.iter().flatten().collect::<BTreeSet<_>>() {
        out.push(Slice { name: format!("class_{name}"), member: classes.iter().map(|c| c.as_ref() == Some(name)).collect() });
    }
    out.extend(terciles("speed", &windows.iter().map(mean_speed_m_s).collect::<Vec<_>>()));
    out.extend(terciles("turning", &windows.iter().map(turned_rad).collect::<Vec<_>>()));
    out.extend(terciles("relief", &windows.iter().map(relief_rad).collect::<Vec<_>>()));
    if let Some(slip) = windows.iter().map(|w| mean_slip(w, wheel_radius_m)).collect::<Option<Vec<_>>>() {
        out.extend(terciles("slip", &slip));
    }
    out.retain(|s| s.windows() > 0 && s.windows() < windows.len());
    out
}

fn terciles(name: &str, values: &[f64]) -> [Slice; 3] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cuts = [1.0 / 3.0, 2.0 / 3.0].map(|q| quantile_sorted(&sorted, q));
    let level = |v: &f64| usize::from(*v > cuts[0]) + usize::from(*v > cuts[1]);
    ["low", "medium", "high"]
        .map(|n| format!("{name}_{n}"))
        .into_iter()
        .enumerate()
        .map(|(i, name)| Slice { name, member: values.iter().map(|v| level(v) == i).collect() })
        .collect::<Vec<_>>()
        .try_into()
        .expect("three names give three slices; this is a bug")
}

/// Mean measured forward speed over the window.
fn mean_speed_m_s(w: &Window<'_>) -> f64 {
    let states = &w.trajectory.states[w.start..=w.start + w.horizon];
    states.iter().map(|s| s.velocity_m_s[0]).sum::<f64>() / states.len() as f64
}

/// Magnitude of the heading change over the window.
fn turned_rad(w: &Window<'_>) -> f64 {
    let yaw = |i: usize| w.trajectory.states[i].attitude_rad[2];
    let mut total = 0.0;
    for i in w.start..w.start + w.horizon {
        total += wrap_angle(yaw(i + 1) - yaw(i));
    }
    total.abs()
}

/// Semantic class under the vehicle where the prediction starts.
fn class_at_start(w: &Window<'_>, maps: &[Option<Arc<WorldMap>>]) -> Option<String> {
    let [x, y, _] = w.trajectory.states[w.start].position_m;
    maps.get(w.drive)?.as_ref()?.soil_class(x, y).map(|class| class.name.clone())
}

/// How far roll and pitch spread over the window: the root of the sum of their variances.
fn relief_rad(w: &Window<'_>) -> f64 {
    let states = &w.trajectory.states[w.start..=w.start + w.horizon];
    let variance = |axis: usize| {
        let mean = states.iter().map(|s| s.attitude_rad[axis]).sum::<f64>() / states.len() as f64;
        states.iter().map(|s| (s.attitude_rad[axis] - mean).powi(2)).sum::<f64>() / states.len() as f64
    };
    (variance(0) + variance(1)).sqrt()
}

/// Mean magnitude of the slip of the mean wheel, by the greater of wheel and ground speed; `None` where wheel speeds are not measured.
fn mean_slip(w: &Window<'_>, wheel_radius_m: f64) -> Option<f64> {
    /// Below this both speeds are noise.
    const STANDING_M_S: f64 = 0.3;
    let wheels = w.trajectory.wheel_speed_rad_s.as_ref()?;
    let slip = |i: usize| {
        let rolling = wheels[i].iter().sum::<f64>() / wheels[i].len() as f64 * wheel_radius_m;
        let ground = w.trajectory.states[i].velocity_m_s[0];
        (rolling - ground).abs() / rolling.abs().max(ground.abs()).max(STANDING_M_S)
    };
    Some((w.start..=w.start + w.horizon).map(slip).sum::<f64>() / (w.horizon + 1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_terciles_part_the_windows() {
        let values: Vec<f64> = (0..9).map(f64::from).collect();
        let parts = terciles("speed", &values);
        assert_eq!(parts.each_ref().map(Slice::windows), [3, 3, 3]);
        assert!((0..9).all(|w| parts.iter().filter(|s| s.member[w]).count() == 1));
        assert!(parts[2].member[8] && parts[0].member[0]);
    }
}
