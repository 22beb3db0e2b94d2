//! The vehicle: publishes a recorded drive over Zenoh and hears what becomes of each measurement.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{measurement, outcome_label};
use nesam_trajectories::Trajectory;
use tokio::sync::watch;

use crate::failure::{Failure, OrFail};

/// Longest wait for the answer to a measurement.
const ANSWER_WAIT: Duration = Duration::from_secs(5);
/// In fast mode, samples between plans.
pub const FAST_STRIDE: usize = 5;

/// Plays a drive.
pub struct Player {
    /// Drive to play.
    pub drive: Arc<Trajectory>,
    /// Samples to publish.
    pub samples: usize,
    /// The planner plans below this sample.
    pub plan_until: usize,
    /// Playback speed.
    pub rate: f64,
    /// Waits for the planner instead of for the clock.
    pub fast: bool,
    /// Tells which sample the service has in its history.
    pub applied: watch::Sender<Option<usize>>,
    /// Which sample the planner has planned at.
    pub planned: watch::Receiver<Option<usize>>,
}

impl Player {
    /// Publishes the drive; gives the number of answers of each kind.
    pub async fn play(mut self, vehicle: &ZenohVehicle) -> Result<BTreeMap<&'static str, usize>, Failure> {
        let mut outcomes = BTreeMap::new();
        let begin = Instant::now();
        for i in 0..self.samples {
            let outcome = self.publish(vehicle, i).await?;
            *outcomes.entry(outcome).or_insert(0) += 1;
            if matches!(outcome, "APPLIED" | "GATED" | "GAP") {
                self.applied.send_replace(Some(i));
            }
            if self.fast {
                self.wait_for_plan(i).await;
            } else {
                let due = begin + Duration::from_secs_f64((i + 1) as f64 * self.drive.dt_s / self.rate);
                tokio::time::sleep_until(due.into()).await;
            }
        }
        Ok(outcomes)
    }

    async fn publish(&self, vehicle: &ZenohVehicle, i: usize) -> Result<&'static str, Failure> {
        let stamp_ns = (self.drive.time_s[i] * 1e9).round() as i64;
        let command = self.drive.controls[i];
        let mut message = measurement("", stamp_ns, self.drive.states[i].to_array(), [command.speed_m_s, command.second]);
        message.sequence = i as u64 + 1;
        vehicle.publish(&message).await.or_failed()?;
        loop {
            let answer = vehicle.answer(ANSWER_WAIT).await.or_failed()?;
            let answer =
                answer.ok_or_else(|| Failure::Failed(format!("no answer to measurement {i} within {} s", ANSWER_WAIT.as_secs())))?;
            if answer.sequence == message.sequence {
                return Ok(outcome_label(&answer));
            }
        }
    }

    async fn wait_for_plan(&mut self, i: usize) {
        if i.is_multiple_of(FAST_STRIDE) && i < self.plan_until {
            let _ = self.planned.wait_for(|planned| planned.is_some_and(|p| p >= i)).await;
        }
    }
}
