//! What `nesam diagnose` says on its standard error.

/// Beginning of a remark.
const NOTE: &str = "note: ";
/// Beginning of why the command failed.
const ERROR: &str = "error: ";

/// A line of the command.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Line<'a> {
    /// How far a stage is: `hypotheses: 3/6 after 10 s`, at its end `hypotheses: 6 in 13.0 s`.
    Progress {
        stage: &'a str,
        done: u64,
        total: u64,
    },
    /// A remark, without the word for it.
    Note(&'a str),
    /// The first line of why it failed, without the word for it.
    Error(&'a str),
    Other(&'a str),
}

impl<'a> Line<'a> {
    /// Reads a line.
    pub fn of(text: &'a str) -> Self {
        if let Some(error) = text.strip_prefix(ERROR) {
            return Self::Error(error);
        }
        if let Some(note) = text.strip_prefix(NOTE) {
            return Self::Note(note);
        }
        match progress(text) {
            Some((stage, done, total)) => Self::Progress { stage, done, total },
            None => Self::Other(text),
        }
    }
}

fn progress(text: &str) -> Option<(&str, u64, u64)> {
    let (stage, rest) = text.rsplit_once(": ")?;
    let (counted, took) = rest.split_once(" after ").or_else(|| rest.split_once(" in "))?;
    took.strip_suffix(" s")?.parse::<f64>().ok()?;
    let (done, total) = counted.split_once('/').unwrap_or((counted, counted));
    Some((stage, done.parse().ok()?, total.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: the lines of the command are understood. Method: lines as it prints them; that it still prints them so is held by the test that starts one
    /// (`crates/cli/tests/diagnosis.rs`).
    #[test]
    fn regress_lines_of_the_command_are_read() {
        let progress = |stage, done, total| Line::Progress { stage, done, total };
        for (text, expected) in [
            ("drives as the model sees them: 5/6 after 10 s", progress("drives as the model sees them", 5, 6)),
            ("drives held against every effect: 6 in 7.1 s", progress("drives held against every effect", 6, 6)),
            ("controls: rivals: 1/3 after 20 s", progress("controls: rivals", 1, 3)),
            (
                "note: the recording was made with bundle a 1; b 2 is diagnosed",
                Line::Note("the recording was made with bundle a 1; b 2 is diagnosed"),
            ),
            ("error: session `x` is not in it", Line::Error("session `x` is not in it")),
            ("hypotheses: -1/3 after 10 s", Line::Other("hypotheses: -1/3 after 10 s")),
            ("hypotheses: 1/3 after noon", Line::Other("hypotheses: 1/3 after noon")),
            ("", Line::Other("")),
        ] {
            assert_eq!(Line::of(text), expected, "{text}");
        }
    }
}
