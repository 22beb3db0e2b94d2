//! A stream of measurements.

use nesam_proto::v1;
use tokio::sync::mpsc;
use tonic::Streaming;

use crate::error::ClientError;

/// Measurements that may wait in the client.
pub(crate) const WAITING_MAX: usize = 64;

/// An open stream: measurements go in, answers come out in the same order.
#[derive(Debug)]
pub struct MeasurementStream {
    pub(crate) sender: mpsc::Sender<v1::Measurement>,
    pub(crate) answers: Streaming<v1::MeasurementAnswer>,
}

impl MeasurementStream {
    /// Sends one measurement; waits only while the service is behind.
    ///
    /// # Errors
    /// `ClientError::Protocol` when the stream has ended.
    pub async fn send(&self, measurement: v1::Measurement) -> Result<(), ClientError> {
        self.sender.send(measurement).await.map_err(|_| ClientError::protocol("the measurement stream has ended"))
    }

    /// The next answer; `None` after the last.
    ///
    /// # Errors
    /// `ClientError::Refused` when the service ended the stream.
    pub async fn answer(&mut self) -> Result<Option<v1::MeasurementAnswer>, ClientError> {
        Ok(self.answers.message().await?)
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
