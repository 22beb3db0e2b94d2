//! `Sessions.WatchAlarms`.

use nesam_engine::{EngineError, Event};
use nesam_proto::v1 as pb;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{Edge, ReplyStream, stopped};
use crate::access::Wish;
use crate::convert::{alarm_message, to_status};
use crate::telemetry::Transport;

/// Begins to tell the alarms of one session.
///
/// # Errors
/// NOT_FOUND for a session that is not open, and the refusals of [`crate::access`].
pub async fn watch(edge: Edge, request: Request<pb::WatchAlarmsRequest>) -> Result<Response<ReplyStream<pb::Alarm>>, Status> {
    edge.engine.metrics().request(Transport::Grpc, "watch_alarms");
    edge.allow(&request, Wish::ReadSession(&request.get_ref().session_id))?;
    // Listening starts before reading, so that no alarm falls between the two.
    let events = edge.events.subscribe();
    let session = request.into_inner().session_id;
    let view = edge.engine.get(&session, edge.stream_budget()).await.map_err(to_status)?;
    let (sender, receiver) = mpsc::channel(16);
    if let Some(alarm) = &view.alarm {
        let _ = sender.try_send(Ok(alarm_message(&session, &view.vehicle, alarm)));
    }
    tokio::spawn(forward(edge, session, events, sender));
    Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
}

/// Sends the alarms of one session until it closes, the watcher leaves or the server stops.
async fn forward(edge: Edge, session: String, mut events: broadcast::Receiver<Event>, sender: mpsc::Sender<Result<pb::Alarm, Status>>) {
    let stop = stopped(edge.stopping.clone());
    tokio::pin!(stop);
    loop {
        let event = tokio::select! {
            event = events.recv() => event,
            () = sender.closed() => return,
            () = &mut stop => {
                let _ = sender.send(Err(Status::unavailable(EngineError::Stopped.to_string()))).await;
                return;
            }
        };
        let alarm = match event {
            Ok(Event::AlarmChanged { session: of, vehicle, alarm }) if of == session => alarm_message(&session, &vehicle, &alarm),
            Ok(Event::SessionClosed { session: closed, .. }) if closed == session => return,
            Ok(_) => continue,
            // Too slow a watcher misses episodes that have ended, never the one that is active.
            Err(RecvError::Lagged(_)) => match edge.engine.get(&session, edge.stream_budget()).await {
                Ok(view) => match &view.alarm {
                    Some(alarm) => alarm_message(&session, &view.vehicle, alarm),
                    None => continue,
                },
                Err(_) => return,
            },
            Err(RecvError::Closed) => return,
        };
        if sender.send(Ok(alarm)).await.is_err() {
            return;
        }
    }
}
