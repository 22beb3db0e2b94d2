//! What the demo ends with.

use std::collections::BTreeMap;

use nesam_evaluation::Provenance;
use serde_json::{Value, json};

use super::ledger::Score;
use crate::output::say;

/// Figures of one demo.
pub struct Summary {
    /// Drive that was played.
    pub drive: String,
    /// Seconds of the drive that were played.
    pub played_s: f64,
    /// Time it took, s.
    pub wall_s: f64,
    /// Errors at 1 s and at 3.2 s.
    pub scores: [Score; 2],
    /// Round-trip times of predictions: median, 90 %, 99 %, s.
    pub latency_s: Vec<f64>,
    /// Predictions asked for and compared.
    pub queries: usize,
    /// Candidate sequences rolled out.
    pub candidates: usize,
    /// Mean cost of the best candidate.
    pub plan_cost: f64,
    /// Answers to the measurements.
    pub outcomes: BTreeMap<&'static str, usize>,
}

impl Summary {
    /// Prints the figures.
    pub fn print(&self) {
        say!("\nplayed {:.1} s of drive {} in {:.1} s", self.played_s, self.drive, self.wall_s);
        let outcomes: Vec<String> = self.outcomes.iter().map(|(name, n)| format!("{name} {n}")).collect();
        say!("measurements over zenoh   {}", if outcomes.is_empty() { "interrupted".into() } else { outcomes.join(", ") });
        let ms: Vec<String> = self.latency_s.iter().map(|s| format!("{:.1}", 1e3 * s)).collect();
        say!("predictions over grpc     {} with {} candidates; round trip p50/p90/p99 {} ms", self.queries, self.candidates, ms.join("/"));
        for score in self.scores.iter().filter(|s| s.count > 0) {
            say!(
                "position error at {:.1} s   nesam {:.3} m, constant velocity {:.3} m (means over {} predictions)",
                score.ahead_s,
                score.nesam_m,
                score.constant_velocity_m,
                score.count
            );
        }
    }

    /// The figures as JSON.
    pub fn to_json(&self, diagnoses: &[Value], provenance: &Provenance) -> String {
        let number = |v: f64| v.is_finite().then_some(v);
        let scores: Vec<_> = self
            .scores
            .iter()
            .map(|s| json!({"ahead_s": s.ahead_s, "predictions": s.count, "nesam_m": number(s.nesam_m), "constant_velocity_m": number(s.constant_velocity_m)}))
            .collect();
        let document = json!({
            "schema": "nesam.demo/1",
            "trajectory": self.drive,
            "played_s": self.played_s,
            "wall_s": self.wall_s,
            "measurements": self.outcomes,
            "predictions": self.queries,
            "candidates": self.candidates,
            "latency_p50_s": number(self.latency_s[0]),
            "latency_p90_s": number(self.latency_s[1]),
            "latency_p99_s": number(self.latency_s[2]),
            "mean_plan_cost": number(self.plan_cost),
            "position_error": scores,
            "diagnoses": diagnoses,
            "provenance": provenance,
        });
        crate::output::json_text(&document)
    }
}
