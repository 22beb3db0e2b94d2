//! Slices: the same errors apart by where and how the vehicle drove, so that a mean hides nothing.

use std::collections::BTreeSet;

use nesam_physics::wrap_angle;

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

/// Slices by world (seen in training or new), by speed and by turning, the last two in terciles of the windows given.
/// `training_worlds` is empty when it is not known which worlds were trained on; then no slice is made by world.
pub fn slices(windows: &[Window<'_>], training_worlds: &BTreeSet<String>) -> Vec<Slice> {
    let mut out = Vec::new();
    if !training_worlds.is_empty() {
        let seen = |w: &Window<'_>| w.trajectory.world.as_ref().is_some_and(|world| training_worlds.contains(world));
        let member: Vec<bool> = windows.iter().map(seen).collect();
        out.push(Slice { name: "world_new".into(), member: member.iter().map(|m| !m).collect() });
        out.push(Slice { name: "world_seen_in_training".into(), member });
    }
    out.extend(terciles("speed", &windows.iter().map(mean_speed_m_s).collect::<Vec<_>>()));
    out.extend(terciles("turning", &windows.iter().map(turned_rad).collect::<Vec<_>>()));
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
