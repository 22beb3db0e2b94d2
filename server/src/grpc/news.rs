//! What is told of one session as it changes: of its soil, of its alarms.

use nesam_engine::{EngineError, Event, SessionView};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{Edge, ReplyStream, stopped};
use crate::access::{Caller, Wish};
use crate::convert::to_status;

/// Messages that wait for a watcher.
const WAITING: usize = 16;

/// News of a session: what an event and what a whole session say of it, if anything. The session's name comes first.
pub(super) struct News<M> {
    pub of_event: fn(&str, Event) -> Option<M>,
    pub of_session: fn(&str, &SessionView) -> Option<M>,
}

/// Begins to tell whoever asks the news of one session, first what it says now.
///
/// # Errors
/// As [`Edge::allow`]; NOT_FOUND for a session that is not open.
pub(super) async fn tell<T, M: Send + 'static>(
    edge: Edge,
    request: &Request<T>,
    session: String,
    news: News<M>,
) -> Result<Response<ReplyStream<M>>, Status> {
    let caller = edge.access.caller(request)?;
    edge.allow_caller(&caller, Wish::ReadSession(&session), edge.budget(request)).await?;
    // Listening starts before reading, so that nothing falls between the two.
    let events = edge.events.subscribe();
    let view = edge.engine.get(&session, edge.stream_budget()).await.map_err(to_status)?;
    let (sender, receiver) = mpsc::channel(WAITING);
    if let Some(message) = (news.of_session)(&session, &view) {
        let _ = sender.try_send(Ok(message));
    }
    tokio::spawn(forward(edge, caller, session, news, events, sender));
    Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
}

/// Sends the news until the session closes, the watcher leaves or has no right to it any more, or the server stops.
async fn forward<M: Send + 'static>(
    edge: Edge,
    caller: Caller,
    session: String,
    news: News<M>,
    mut events: broadcast::Receiver<Event>,
    sender: mpsc::Sender<Result<M, Status>>,
) {
    let stop = stopped(edge.stopping.clone());
    let lost = caller.loses(Wish::ReadSession(&session));
    tokio::pin!(stop, lost);
    loop {
        let event = tokio::select! {
            event = events.recv() => event,
            () = sender.closed() => return,
            status = &mut lost => {
                let _ = sender.send(Err(status)).await;
                return;
            }
            () = &mut stop => {
                let _ = sender.send(Err(Status::unavailable(EngineError::Stopped.to_string()))).await;
                return;
            }
        };
        let message = match event {
            Ok(Event::SessionClosed { session: closed, .. }) if closed == session => return,
            Ok(event) => (news.of_event)(&session, event),
            // Too slow a watcher misses what has passed, never what holds.
            Err(RecvError::Lagged(_)) => match edge.engine.get(&session, edge.stream_budget()).await {
                Ok(view) => (news.of_session)(&session, &view),
                Err(_) => return,
            },
            Err(RecvError::Closed) => return,
        };
        if let Some(message) = message
            && sender.send(Ok(message)).await.is_err()
        {
            return;
        }
    }
}
