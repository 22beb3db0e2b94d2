//! A stream of measurements.

use std::sync::{Mutex, PoisonError};

use nesam_proto::v1;
use tokio::sync::mpsc;
use tonic::Streaming;

use crate::error::ClientError;
use crate::known_states::{KnownStates, Waiting};

/// Measurements that may wait in the client.
pub(crate) const WAITING_MAX: usize = 64;

/// An open stream: measurements go in, answers come out in the same order.
#[derive(Debug)]
pub struct MeasurementStream {
    sender: mpsc::Sender<v1::Measurement>,
    answers: Streaming<v1::MeasurementAnswer>,
    /// What was sent and not answered yet.
    waiting: Mutex<Waiting>,
}

impl MeasurementStream {
    pub(crate) fn new(sender: mpsc::Sender<v1::Measurement>, answers: Streaming<v1::MeasurementAnswer>, known: KnownStates) -> Self {
        Self { sender, answers, waiting: Mutex::new(Waiting::new(known)) }
    }

    /// Sends one measurement; waits only while the service is behind.
    ///
    /// # Errors
    /// `ClientError::Protocol` when the stream has ended.
    pub async fn send(&self, measurement: v1::Measurement) -> Result<(), ClientError> {
        let place = self.sender.reserve().await;
        // Under the lock, so that both queues have the same order.
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.push(&measurement);
        match place {
            Ok(place) => place.send(measurement),
            Err(_) => {
                waiting.unheard();
                return Err(ClientError::protocol("the measurement stream has ended"));
            }
        }
        Ok(())
    }

    /// The next answer; `None` after the last.
    ///
    /// # Errors
    /// `ClientError::Refused` when the service ended the stream.
    pub async fn answer(&mut self) -> Result<Option<v1::MeasurementAnswer>, ClientError> {
        let answer = self.answers.message().await;
        let waiting = self.waiting.get_mut().unwrap_or_else(PoisonError::into_inner);
        match &answer {
            Ok(Some(answer)) => waiting.answered(answer),
            _ => waiting.unheard(),
        }
        Ok(answer?)
    }

    /// Sends one measurement and awaits its answer.
    ///
    /// # Errors
    /// As [`MeasurementStream::send`] and [`MeasurementStream::answer`].
    pub async fn exchange(&mut self, measurement: v1::Measurement) -> Result<v1::MeasurementAnswer, ClientError> {
        self.send(measurement).await?;
        self.answer().await?.ok_or_else(|| ClientError::protocol("the measurement stream has ended"))
    }

    /// Says that no more measurements come; the remaining answers can still be read.
    pub fn finish(self) -> Streaming<v1::MeasurementAnswer> {
        self.answers
    }
}
