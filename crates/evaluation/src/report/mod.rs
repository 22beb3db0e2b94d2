//! Self-contained HTML reports: one file, no network, readable by day and by night.
//!
//! [`Page`], [`Table`] and [`LinePlot`] know nothing of evaluation; every command that writes `--html` uses them, so that the reports
//! share one look. Colours are those of Okabe and Ito (2008), distinguishable with any common colour blindness; lines differ by
//! dash as well.

mod adaptation;
mod evaluation;
mod line_plot;
mod page;
mod scale;
mod short;
mod table;

pub use adaptation::adaptation_page;
pub use evaluation::{evaluation_markdown, evaluation_page};
pub use line_plot::{LinePlot, Series};
pub use page::{Page, escape};
pub use scale::ticks;
pub use short::Short;
pub use table::Table;
