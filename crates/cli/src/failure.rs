//! Why a command did not do what was asked, and the exit code that says so.

use std::error::Error;
use std::fmt;
use std::process::ExitCode;

/// A command that ended early. The text is for a person: what was wrong, where, and what to do.
#[derive(Debug)]
pub enum Failure {
    /// Wrong usage or input: exit code 2. Trying again without changing the input cannot help.
    Input(String),
    /// The work itself failed: exit code 1.
    Failed(String),
}

impl Failure {
    /// 2 for wrong input, 1 for failed work.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Input(_) => ExitCode::from(2),
            Self::Failed(_) => ExitCode::from(1),
        }
    }

    /// Wrong usage or input.
    pub fn input(text: impl Into<String>) -> Self {
        Self::Input(text.into())
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Input(text) | Self::Failed(text) => f.write_str(text),
        }
    }
}

/// Turns library errors into failures; the caller knows whether the input or the work is at fault.
pub trait OrFail<T> {
    /// The input is at fault (exit code 2).
    fn or_input(self) -> Result<T, Failure>;
    /// The work failed (exit code 1).
    fn or_failed(self) -> Result<T, Failure>;
}

impl<T, E: Error> OrFail<T> for Result<T, E> {
    fn or_input(self) -> Result<T, Failure> {
        self.map_err(|e| Failure::Input(chain(&e)))
    }

    fn or_failed(self) -> Result<T, Failure> {
        self.map_err(|e| Failure::Failed(chain(&e)))
    }
}

/// The error with its sources, each said once.
pub fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        let inner_text = inner.to_string();
        if !text.contains(&inner_text) {
            text = format!("{text}: {inner_text}");
        }
        source = inner.source();
    }
    text
}
