//! Names that somebody sent, as they may stand in a sentence.

use core::fmt::{Display, Formatter, Result, Write};

use crate::limits::NAME_LENGTH_MAX;

/// A name in a sentence or a line of a log: one line, what does not print as it is written in programs, and no longer than names may be.
#[derive(Clone, Copy, Debug)]
pub struct Shown<'a>(pub &'a str);

impl Display for Shown<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        for c in self.0.chars().take(NAME_LENGTH_MAX) {
            // A backtick ends a name.
            if c == '`' {
                f.write_str("\\u{60}")?;
            } else if matches!(c, '\'' | '"') {
                f.write_char(c)?;
            } else {
                write!(f, "{}", c.escape_debug())?;
            }
        }
        match self.0.chars().skip(NAME_LENGTH_MAX).count() {
            0 => Ok(()),
            more => write!(f, "… ({more} more characters)"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: no name makes a second line, ends its quotation or fills a log; usual ones are as they are. Method: names with line feeds, backticks, a mark that turns the
    /// direction of writing, and 10 000 letters.
    #[test]
    fn regress_names_stay_in_their_sentence() {
        assert_eq!(Shown("truck-8.Ж:é '1'").to_string(), "truck-8.Ж:é '1'");
        assert_eq!(Shown("x` by=\"y\"\n2026 INFO\u{1b}\u{202e}").to_string(), "x\\u{60} by=\"y\"\\n2026 INFO\\u{1b}\\u{202e}");
        let long = Shown(&"ж".repeat(10_000)).to_string();
        assert!(long.starts_with("жж") && long.ends_with("… (9936 more characters)") && long.chars().count() < 120, "{long}");
    }
}
