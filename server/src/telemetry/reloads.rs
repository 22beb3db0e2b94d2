//! Files that are read again while the server runs: what became of their changes, and whether what is there now can be used.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// What is read again by itself: what is wrong with one keeps no change of another out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Certificate and key of the server, and the authority of its clients.
    Certificate,
    /// The fleet file.
    Rights,
    /// What the server shows etcd, and whom it believes there.
    Cluster,
}

impl Part {
    const ALL: [Self; 3] = [Self::Certificate, Self::Rights, Self::Cluster];

    /// Value of the `part` label.
    pub fn label(self) -> &'static str {
        match self {
            Self::Certificate => "certificate",
            Self::Rights => "rights",
            Self::Cluster => "cluster",
        }
    }
}

/// What is counted of each part.
#[derive(Debug, Default)]
pub struct Reloads([Counts; Part::ALL.len()]);

#[derive(Debug, Default)]
struct Counts {
    /// Changes that were not usable, and that were.
    changes: [AtomicU64; 2],
    unusable: AtomicBool,
    /// When its certificate expires, s since 1970; 0 = it has none.
    expires_s: AtomicU64,
}

impl Reloads {
    fn of(&self, part: Part) -> &Counts {
        &self.0[part as usize]
    }

    /// Counts that a part has changed, and whether that was usable.
    pub fn changed(&self, part: Part, usable: bool) {
        self.of(part).changes[usize::from(usable)].fetch_add(1, Ordering::Relaxed);
    }

    /// Notes whether what is there now of a part cannot be used.
    pub fn unusable(&self, part: Part, unusable: bool) {
        self.of(part).unusable.store(unusable, Ordering::Relaxed);
    }

    /// Notes when the certificate of a part that is in force expires, s since 1970.
    pub fn expires(&self, part: Part, at_s: u64) {
        self.of(part).expires_s.store(at_s, Ordering::Relaxed);
    }

    /// In Prometheus' text format. Everything from the start, so that the first failure is an increase.
    pub fn render(&self, out: &mut String) {
        let name = "nesam_credentials_reloads_total";
        let _ = writeln!(
            out,
            "# HELP {name} Changes of certificates and rights, by part and by whether they were usable.\n# TYPE {name} counter"
        );
        for (part, counts) in Part::ALL.iter().zip(&self.0) {
            for (result, count) in ["failed", "ok"].iter().zip(&counts.changes) {
                let _ = writeln!(out, "{name}{{part=\"{}\",result=\"{result}\"}} {}", part.label(), count.load(Ordering::Relaxed));
            }
        }
        let name = "nesam_credentials_unusable";
        let help = "1 while the files of a part cannot be used: what they held before stays in force.";
        let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} gauge");
        for (part, counts) in Part::ALL.iter().zip(&self.0) {
            let _ = writeln!(out, "{name}{{part=\"{}\"}} {}", part.label(), u8::from(counts.unusable.load(Ordering::Relaxed)));
        }
        for (part, name, whose) in [
            (
                Part::Certificate,
                "nesam_certificate_expires_seconds",
                "the certificate of the server expires, since 1970; without TLS there is none",
            ),
            (
                Part::Cluster,
                "nesam_cluster_certificate_expires_seconds",
                "the certificate that the server shows etcd expires, since 1970; without one there is none",
            ),
        ] {
            let _ = writeln!(out, "# HELP {name} When {whose}.\n# TYPE {name} gauge");
            let expires_s = self.of(part).expires_s.load(Ordering::Relaxed);
            if expires_s > 0 {
                let _ = writeln!(out, "{name} {expires_s}");
            }
        }
    }
}
