//! `effects.toml` of a bundle: the physical effects that act on top of its vehicle card.
//!
//! Each entry is an id of the catalogue, its parameters by name and, where it does not act always, the onset in s since the start of the log. The file is listed in the manifest like every other, so an effect cannot be
//! slipped into a bundle unseen; an unknown id, a missing or unknown parameter and a value outside its physical range are refused.
//!
//! An effect that the catalogue does not have is written down as formulas with units (`[[written]]`, [`nesam_physics::effects::written`]):
//!
//! ```toml
//! [[written]]
//! id = "snow_plough"
//! force_x = "-(push + per_speed * abs(v_ahead)) * tanh(v_ahead / fade)"     # N; also force_y, force_z, moment_x, moment_y, moment_z (N m)
//! share = 1.0                                                                # of what is written; left out: 1
//! parameters.push = { value = 300.0, unit = "N", range = [0.0, 2000.0] }
//! parameters.per_speed = { value = 80.0, unit = "N s/m", range = [0.0, 500.0] }
//! parameters.fade = { value = 0.2, unit = "m/s", range = [0.05, 1.0] }
//! ```

use std::collections::BTreeMap;

use nesam_physics::effects::written::{WRITTEN_MAX, WrittenParameter, WrittenText};
use nesam_physics::effects::{Effect, ScheduledEffect, Written, places_at_fault};
use serde::{Deserialize, Serialize};

/// Version of the file; absent in files without effects.
const FORMAT: &str = "nesam.effects/1";
/// The text of a bundle without effects.
const NONE: &str = "# Effects found by `nesam diagnose`; none yet.\neffects = []\n";

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct EffectsFile {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    format: Option<String>,
    #[serde(default)]
    effects: Vec<Entry>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    written: Vec<WrittenEntry>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    id: String,
    #[serde(default, skip_serializing_if = "is_zero")]
    onset_s: f64,
    parameters: BTreeMap<String, f64>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenEntry {
    id: String,
    #[serde(default, skip_serializing_if = "is_zero")]
    onset_s: f64,
    #[serde(default = "whole", skip_serializing_if = "is_whole")]
    share: f64,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    force_x: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    force_y: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    force_z: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    moment_x: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    moment_y: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    moment_z: String,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    parameters: BTreeMap<String, ParameterEntry>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ParameterEntry {
    value: f64,
    unit: String,
    range: [f64; 2],
}

impl WrittenEntry {
    fn of(written: &Written, onset_s: f64) -> Self {
        let text = written.text();
        let [force_x, force_y, force_z, moment_x, moment_y, moment_z] = text.formulas.clone();
        let entry = |p: &WrittenParameter| (p.name.clone(), ParameterEntry { value: p.value, unit: p.unit.clone(), range: p.range });
        let parameters = text.parameters.iter().map(entry).collect();
        Self { id: text.id.clone(), onset_s, share: written.share(), force_x, force_y, force_z, moment_x, moment_y, moment_z, parameters }
    }

    fn effect(self) -> Result<ScheduledEffect, String> {
        let onset_s = onset(&self.id, self.onset_s)?;
        let share = self.share;
        let parameter = |(name, p): (String, ParameterEntry)| WrittenParameter { name, value: p.value, unit: p.unit, range: p.range };
        let text = WrittenText {
            id: self.id,
            formulas: [self.force_x, self.force_y, self.force_z, self.moment_x, self.moment_y, self.moment_z],
            parameters: self.parameters.into_iter().map(parameter).collect(),
        };
        let effect = Effect::Written(Written::read(&text)?.at(share));
        in_range(&effect)?;
        Ok(ScheduledEffect { effect, onset_s })
    }
}

fn is_zero(onset_s: &f64) -> bool {
    *onset_s == 0.0
}

fn whole() -> f64 {
    1.0
}

fn is_whole(share: &f64) -> bool {
    *share == 1.0
}

/// Reads the text of an `effects.toml`.
///
/// # Errors
/// What is wrong, to follow the name of the file.
pub fn read(text: &str) -> Result<Vec<ScheduledEffect>, String> {
    let file: EffectsFile = toml::from_str(text).map_err(|e| format!("is not readable: {e}"))?;
    if let Some(format) = file.format.filter(|f| f != FORMAT) {
        return Err(format!("has format `{format}`, this program reads `{FORMAT}`"));
    }
    if file.written.len() > WRITTEN_MAX {
        return Err(format!("has {} written effects; {WRITTEN_MAX} can act at once", file.written.len()));
    }
    let written: Vec<ScheduledEffect> = file.written.into_iter().map(WrittenEntry::effect).collect::<Result<_, _>>()?;
    // What is added to a bundle that has it acts beside it.
    let same = |a: &Written, b: &Written| a.id() == b.id() && a.text() != b.text();
    let texts: Vec<Written> = written.iter().filter_map(|e| e.effect.written()).collect();
    if let Some(twice) = texts.iter().find(|a| texts.iter().any(|b| same(a, b))) {
        return Err(format!("has two written effects `{}` that differ", twice.id()));
    }
    let named: Vec<ScheduledEffect> = file.effects.iter().map(effect).collect::<Result<_, _>>()?;
    let plain: Vec<Effect> = named.iter().map(|e| e.effect).collect();
    if let Some(fault) = places_at_fault(&plain) {
        return Err(fault);
    }
    Ok(named.into_iter().chain(written).collect())
}

/// The text of a list of effects, as [`read`] reads it.
pub fn write(effects: &[ScheduledEffect]) -> String {
    if effects.is_empty() {
        return NONE.into();
    }
    let entry = |e: &ScheduledEffect| Entry {
        id: e.effect.id().into(),
        onset_s: e.onset_s,
        parameters: e.effect.parameters().iter().map(|p| (p.name.to_string(), p.value)).collect(),
    };
    let named = effects.iter().filter(|e| !matches!(e.effect, Effect::Written(_))).map(entry).collect();
    let written = |e: &ScheduledEffect| if let Effect::Written(w) = &e.effect { Some(WrittenEntry::of(w, e.onset_s)) } else { None };
    let file = EffectsFile { format: Some(FORMAT.into()), effects: named, written: effects.iter().filter_map(written).collect() };
    let text = toml::to_string(&file).expect("names and numbers serialise; this is a bug");
    format!("# Effects found by `nesam diagnose`, added to the vehicle card.\n{text}")
}

/// An effect by its id and its parameters by name, acting always.
///
/// # Errors
/// What is wrong: an unknown id, a missing or unknown parameter, a value outside its physical range. The text follows the name of what holds the effect.
pub fn named_effect(id: &str, parameters: &BTreeMap<String, f64>) -> Result<ScheduledEffect, String> {
    effect(&Entry { id: id.into(), onset_s: 0.0, parameters: parameters.clone() })
}

fn effect(entry: &Entry) -> Result<ScheduledEffect, String> {
    let id = &entry.id;
    let form = Effect::example(id).ok_or_else(|| format!("names the effect `{id}`; this program knows {}", Effect::IDS.join(", ")))?;
    let names: Vec<&str> = form.quantities().iter().map(|q| q.name).collect();
    if let Some(unknown) = entry.parameters.keys().find(|k| !names.contains(&k.as_str())) {
        return Err(format!("gives `{id}` the parameter `{unknown}`; it has {}", names.join(", ")));
    }
    let value = |name: &&str| entry.parameters.get(*name).copied().ok_or_else(|| format!("gives `{id}` no `{name}`"));
    let values = names.iter().map(value).collect::<Result<Vec<f64>, String>>()?;
    let effect = Effect::from_parameters(id, &values).expect("the number of parameters was checked; this is a bug");
    in_range(&effect)?;
    Ok(ScheduledEffect { effect, onset_s: onset(id, entry.onset_s)? })
}

fn in_range(effect: &Effect) -> Result<(), String> {
    match effect.parameters().iter().find(|p| !(p.range[0]..=p.range[1]).contains(&p.value)) {
        None => Ok(()),
        Some(p) => Err(format!("gives `{}` {} = {} {}, outside {}…{}", effect.id(), p.name, p.value, p.unit, p.range[0], p.range[1])),
    }
}

fn onset(id: &str, onset_s: f64) -> Result<f64, String> {
    if !onset_s.is_finite() || onset_s < 0.0 {
        return Err(format!("gives `{id}` onset_s = {onset_s}; it is a time of 0 or more since the start of the log"));
    }
    Ok(onset_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_physics::effects::{PLACES_MAX, Payload, SoilDrift, SteeringOffset, WheelDrag};

    #[test]
    fn property_effects_round_trip_bit_for_bit() {
        let effects = vec![
            Effect::Payload(Payload { mass_kg: 623.390_000_000_1, at_m: [-1.4, 0.1 + 0.2, 0.77] }),
            Effect::WheelDrag(WheelDrag { wheel: 3, torque_n_m: 900.0 }),
            Effect::SteeringOffset(SteeringOffset { second: -1.0 / 3.0 }),
        ];
        let mut effects: Vec<ScheduledEffect> = effects.into_iter().chain(Effect::examples()).map(Into::into).collect();
        effects[2].onset_s = 12.3;
        let text = write(&effects);
        assert_eq!(read(&text).unwrap(), effects, "{text}");
    }

    const PLOUGH: &str = r#"
[[written]]
id = "snow_plough"
onset_s = 4.0
share = 0.75
force_x = "-(push + per_speed * abs(v_ahead)) * tanh(v_ahead / fade)"
moment_z = "0.3 * mass * gravity * wheelbase * slope_left"
parameters.push = { value = 300.0, unit = "N", range = [0.0, 2000.0] }
parameters.per_speed = { value = 80.0, unit = "N s/m", range = [0.0, 500.0] }
parameters.fade = { value = 0.2, unit = "m/s", range = [0.05, 1.0] }
parameters.wheelbase = { value = 3.3, unit = "m", range = [1.0, 5.0] }
"#;

    #[test]
    fn property_written_effects_round_trip_beside_named_ones() {
        let text = format!("format = \"{FORMAT}\"\n[[effects]]\nid = \"steering_offset\"\nparameters = {{ second = 0.1 }}\n{PLOUGH}");
        let effects = read(&text).unwrap();
        assert_eq!(
            effects.iter().map(|e| (e.effect.id(), e.onset_s)).collect::<Vec<_>>(),
            [("steering_offset", 0.0), ("snow_plough", 4.0)]
        );
        let written = write(&effects);
        assert_eq!(read(&written).unwrap(), effects, "{written}");
        assert_eq!(write(&read(&written).unwrap()), written);
    }

    #[test]
    fn property_wrong_written_effects_are_refused_with_the_reason() {
        for (from, to, reason) in [
            ("snow_plough", "payload", "none of the catalogue"),
            ("snow_plough", "Snow Plough", "snake_case"),
            ("v_ahead / fade", "v_ahead", "tanh"),
            ("push + per_speed", "push + 3 * per_speed * abs(v_ahead) / per_speed", "a sum"),
            ("value = 300.0", "value = 3000.0", "outside 0…2000"),
            ("unit = \"N s/m\"", "unit = \"N furlong\"", "furlong"),
            ("moment_z", "moment_y = \"1\"\nmoment_z", "moment_y"),
            ("onset_s = 4.0", "onset_s = nan", "onset_s"),
            ("share = 0.75", "share = -0.5", "share = -0.5 1, outside 0…10"),
            ("share = 0.75", "share = nan", "share"),
            ("parameters.fade", "parameters.share", "the share"),
            ("parameters.fade", "parameters.v_left", "v_left"),
            ("id = ", "formula = 3\nid = ", "not readable"),
        ] {
            let text = PLOUGH.replacen(from, to, 1);
            let error = read(&text).unwrap_err();
            assert!(error.contains(reason), "`{error}` should say `{reason}`");
        }
        let other = PLOUGH.replace("value = 80.0", "value = 81.0");
        assert!(read(&format!("{PLOUGH}{other}")).unwrap_err().contains("two written effects"));
        assert_eq!(read(&PLOUGH.repeat(2)).unwrap().len(), 2, "the same again is more of it");
        let many: String = (0..5).map(|i| PLOUGH.replace("snow_plough", &format!("plough_{i}"))).collect();
        assert!(read(&many).unwrap_err().contains("at once"));
        let nothing = "[[written]]\nid = \"nothing\"\n";
        assert!(read(nothing).unwrap_err().contains("no formula"));
    }

    /// Goal: no entry of a file is left out unsaid. Method: as many drifts of the soil at times of their own as can act, the same once more, and one more.
    #[test]
    fn regress_more_places_than_can_act_are_refused() {
        let drifts = |count: usize| -> Vec<ScheduledEffect> {
            let of = |i: usize| Effect::SoilDrift(SoilDrift { factor_end: 0.9, begin_s: i as f64, end_s: 50.0 });
            (0..count).map(|i| of(i).into()).collect()
        };
        let all = [drifts(PLACES_MAX), drifts(1)].concat();
        assert_eq!(read(&write(&all)).unwrap(), all, "the same again is more of it");
        let error = read(&write(&drifts(PLACES_MAX + 1))).unwrap_err();
        assert!(error.contains("`soil_drift` at 5 places"), "{error}");
    }

    #[test]
    fn regress_a_bundle_without_effects_keeps_its_bytes() {
        assert_eq!(write(&[]), "# Effects found by `nesam diagnose`; none yet.\neffects = []\n");
        assert_eq!(read(&write(&[])).unwrap(), []);
    }

    #[test]
    fn property_wrong_files_are_refused_with_the_reason() {
        let one = |body: &str| format!("format = \"{FORMAT}\"\n[[effects]]\n{body}");
        for (text, reason) in [
            ("effects = 3".to_string(), "not readable"),
            ("format = \"nesam.effects/9\"\neffects = []".into(), "nesam.effects/9"),
            (one("id = \"ghost\"\nparameters = {}"), "ghost"),
            (one("id = \"steering_offset\"\nparameters = {}"), "no `second`"),
            (one("id = \"steering_offset\"\nparameters = { second = 0.1, third = 1.0 }"), "third"),
            (one("id = \"steering_offset\"\nparameters = { second = 7.0 }"), "outside"),
            (one("id = \"steering_offset\"\nparameters = { second = nan }"), "outside"),
            (one("id = \"steering_offset\"\nonset_s = -1.0\nparameters = { second = 0.1 }"), "onset_s"),
            (one("id = \"wheel_drag\"\nparameters = { wheel = 9.0, torque_nm = 10.0 }"), "wheel"),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains(reason), "`{error}` should say `{reason}`");
        }
    }
}
