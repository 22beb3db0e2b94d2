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

#[cfg(test)]
mod tests {
    use super::*;

    const PUSH: &str = "[[written]]\nid = \"push\"\nforce_x = \"f\"\nparameters.f = { value = 1.0, unit = \"N\", range = [0.0, 2.0] }\n";

    fn read_text(text: &str) -> Result<Vec<Written>, Failure> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read(Some(file.path()))
    }

    #[test]
    fn property_only_written_effects_without_an_onset_are_hypotheses() {
        assert_eq!(read(None).unwrap(), []);
        assert_eq!(read_text(PUSH).unwrap().iter().map(Written::id).collect::<Vec<_>>(), ["push"]);
        for (text, reason) in [
            ("effects = []".to_string(), "has no effect"),
            ("[[effects]]\nid = \"steering_offset\"\nparameters = { second = 0.1 }\n".into(), "which the catalogue has"),
            (PUSH.replace("force_x", "onset_s = 3.0\nforce_x"), "a diagnosis finds it"),
            (PUSH.repeat(2), "twice"),
            (PUSH.replace("\"N\"", "\"kg\""), "force_x"),
        ] {
            let error = read_text(&text).unwrap_err().to_string();
            assert!(error.contains(reason), "`{error}` should say `{reason}`");
        }
    }
}
