//! What is told of one session as it changes: of its soil, of its alarms.

use nesam_engine::{EngineError, Event, SessionView};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Response, Status};

use super::{Edge, ReplyStream, stopped};
use crate::access::{Caller, Wish};
use crate::cluster::moved;

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
/// As [`Edge::allow`]; NOT_FOUND for a session that is not open, UNAVAILABLE for one that has just left.
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
    let view = read(&edge, &caller, &session).await?;
    let (sender, receiver) = mpsc::channel(WAITING);
    if let Some(message) = (news.of_session)(&session, &view) {
        let _ = sender.try_send(Ok(message));
    }
    tokio::spawn(forward(edge, caller, session, news, events, sender));
    Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
}

/// Sends the news, last why they end where that is not the session's close.
async fn forward<M: Send + 'static>(
    edge: Edge,
    caller: Caller,
    session: String,
    news: News<M>,
    events: broadcast::Receiver<Event>,
    sender: mpsc::Sender<Result<M, Status>>,
) {
    if let Err(status) = follow(&edge, &caller, &session, &news, events, &sender).await {
        let _ = sender.send(Err(status)).await;
    }
}

/// Sends the news until the session closes or the watcher leaves.
///
/// # Errors
/// PERMISSION_DENIED once the watcher has no right to them any more; UNAVAILABLE when the server stops and when the session has left for another one; what keeps
/// a watcher that missed something from reading the session again.
async fn follow<M: Send + 'static>(
    edge: &Edge,
    caller: &Caller,
    session: &str,
    news: &News<M>,
    mut events: broadcast::Receiver<Event>,
    sender: &mpsc::Sender<Result<M, Status>>,
) -> Result<(), Status> {
    let stop = stopped(edge.stopping.clone());
    let lost = caller.loses(Wish::ReadSession(session));
    tokio::pin!(stop, lost);
    loop {
        let event = tokio::select! {
            event = events.recv() => event,
            () = sender.closed() => return Ok(()),
            status = &mut lost => return Err(status),
            () = &mut stop => return Err(Status::unavailable(EngineError::Stopped.to_string())),
        };
        let message = match event {
            Ok(Event::SessionClosed { session: closed, .. }) if closed == session => {
                let left = edge.keeper.as_ref().is_some_and(|keeper| keeper.has_left(session));
                return if left { Err(moved(session)) } else { Ok(()) };
            }
            Ok(event) => (news.of_event)(session, event),
            // Too slow a watcher misses what has passed, never what holds.
            Err(RecvError::Lagged(_)) => match read(edge, caller, session).await {
                Ok(view) => (news.of_session)(session, &view),
                Err(status) if status.code() == Code::NotFound => return Ok(()),
                Err(status) => return Err(status),
            },
            Err(RecvError::Closed) => return Ok(()),
        };
        if let Some(message) = message
            && sender.send(Ok(message)).await.is_err()
        {
            return Ok(());
        }
    }
}

/// The session as it stands, if its vehicle is one that the watcher may read: between two looks a session may have been closed and one of another vehicle opened
/// under its name.
///
/// # Errors
/// PERMISSION_DENIED; what keeps the engine from answering, NOT_FOUND included.
async fn read(edge: &Edge, caller: &Caller, session: &str) -> Result<SessionView, Status> {
    let view = edge.engine.get(session, edge.stream_budget()).await.map_err(|error| edge.status(error))?;
    caller.may_with(Wish::ReadSession(session), &view.vehicle)?;
    Ok(view)
}
