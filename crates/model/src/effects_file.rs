//! `effects.toml` of a bundle: the physical effects that act on top of its vehicle card.
//!
//! Each entry is an id of the catalogue, its parameters by name and, where it does not act always, the onset in s since the start of the log. The file is listed in the manifest like every other, so an effect cannot be
//! slipped into a bundle unseen; an unknown id, a missing or unknown parameter and a value outside its physical range are refused.

use std::collections::BTreeMap;

use nesam_physics::effects::{Effect, ScheduledEffect};
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
    effects: Vec<Entry>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    id: String,
    #[serde(default, skip_serializing_if = "is_zero")]
    onset_s: f64,
    parameters: BTreeMap<String, f64>,
}

fn is_zero(onset_s: &f64) -> bool {
    *onset_s == 0.0
}

/// Reads the effects; the error says what is wrong, to follow the name of the file.
pub(crate) fn read(text: &str) -> Result<Vec<ScheduledEffect>, String> {
    let file: EffectsFile = toml::from_str(text).map_err(|e| format!("is not readable: {e}"))?;
    if let Some(format) = file.format.filter(|f| f != FORMAT) {
        return Err(format!("has format `{format}`, this program reads `{FORMAT}`"));
    }
    file.effects.iter().map(effect).collect()
}

/// The text of a list of effects.
pub(crate) fn write(effects: &[ScheduledEffect]) -> String {
    if effects.is_empty() {
        return NONE.into();
    }
    let entry = |e: &ScheduledEffect| Entry {
        id: e.effect.id().into(),
        onset_s: e.onset_s,
        parameters: e.effect.parameters().iter().map(|p| (p.name.to_string(), p.value)).collect(),
    };
    let file = EffectsFile { format: Some(FORMAT.into()), effects: effects.iter().map(entry).collect() };
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
    for (p, given) in effect.parameters().iter().zip(&values) {
        if !given.is_finite() || *given < p.range[0] || *given > p.range[1] {
            return Err(format!("gives `{id}` {} = {given} {}, outside {}…{}", p.name, p.unit, p.range[0], p.range[1]));
        }
    }
    if !entry.onset_s.is_finite() || entry.onset_s < 0.0 {
        return Err(format!("gives `{id}` onset_s = {}; it is a time of 0 or more since the start of the log", entry.onset_s));
    }
    Ok(ScheduledEffect { effect, onset_s: entry.onset_s })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_physics::effects::{Payload, SteeringOffset, WheelDrag};

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
