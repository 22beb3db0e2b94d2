//! Effects of a session.

use nesam_engine::{AppliedEffect, AppliedEffects, AppliedParameter};
use nesam_proto::v1 as pb;

use super::unsigned_zero;

/// Effects from their messages; the engine says whether the catalogue has them.
pub fn applied_effects(source: &str, effects: &[pb::Effect]) -> AppliedEffects {
    let parameter =
        |p: &pb::EffectParameter| AppliedParameter { name: p.name.clone(), value: unsigned_zero(p.value), sd: unsigned_zero(p.sd) };
    let effect = |e: &pb::Effect| AppliedEffect { id: e.id.clone(), parameters: e.parameters.iter().map(parameter).collect() };
    AppliedEffects { source: source.into(), effects: effects.iter().map(effect).collect() }
}

/// The messages of effects.
pub fn effect_messages(applied: &AppliedEffects) -> Vec<pb::Effect> {
    let parameter = |p: &AppliedParameter| pb::EffectParameter { name: p.name.clone(), value: p.value, sd: p.sd };
    let effect = |e: &AppliedEffect| pb::Effect { id: e.id.clone(), parameters: e.parameters.iter().map(parameter).collect() };
    applied.effects.iter().map(effect).collect()
}
