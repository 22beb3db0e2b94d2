//! Effects that somebody wrote down, to be held against measured drives like those of the catalogue.

use std::path::Path;

use nesam_model::effects_from_toml;
use nesam_physics::effects::{ScheduledEffect, Written};

use crate::failure::Failure;

/// Reads the written effects of a file; none without a file.
pub fn read(file: Option<&Path>) -> Result<Vec<Written>, Failure> {
    let Some(file) = file else { return Ok(Vec::new()) };
    let refused = |reason: String| Failure::input(format!("{} {reason}", file.display()));
    let text = std::fs::read_to_string(file).map_err(|e| refused(format!("cannot be read: {e}")))?;
    let effects = effects_from_toml(&text).map_err(refused)?;
    if effects.is_empty() {
        return Err(refused("has no effect; write one as formulas (docs/your-own-effect.md)".into()));
    }
    let hypothesis = |e: &ScheduledEffect| match e.effect.written() {
        None => Err(refused(format!("names `{}`, which the catalogue has; a hypothesis is a [[written]] effect", e.effect.id()))),
        Some(_) if e.onset_s > 0.0 => Err(refused(format!("gives `{}` an onset; a diagnosis finds it", e.effect.id()))),
        Some(written) => Ok(written),
    };
    let written: Vec<Written> = effects.iter().map(hypothesis).collect::<Result<_, _>>()?;
    match written.iter().enumerate().find(|(i, one)| written[..*i].iter().any(|other| other.id() == one.id())) {
        None => Ok(written),
        Some((_, twice)) => Err(refused(format!("has `{}` twice; a hypothesis is sized once", twice.id()))),
    }
}
