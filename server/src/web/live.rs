//! Open pages: each gets the painter's updates as server-sent events, at its own pace.
//!
//! A page that does not read loses updates, is told how many, and begins anew with everything; nobody waits for it. One that takes nothing for a minute is
//! closed.

use std::convert::Infallible;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse as _, Response};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::mpsc;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;

use super::feed::{Feed, Note};
use super::painter::{Desk, Painter, Update};
use super::reports::Reports;
use super::terrain::Pictures;
use crate::clock::MonotonicClock;
use crate::config::Config;
use crate::grpc::{Edge, stopped};
use crate::http::HttpState;
use crate::recording::Recorder;

/// Longest wait for a page that does not read.
const STALLED: Duration = Duration::from_secs(60);

/// The live page of a service. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Live {
    /// Where answers are noted as they pass.
    pub feed: Feed,
    /// Diagnoses that the page shows.
    pub reports: Reports,
    /// Maps as the page shows them.
    pub pictures: Pictures,
    desk: Arc<Desk>,
    watchers_max: usize,
}

/// A place among the watchers.
struct Place(Arc<Desk>);

impl Drop for Place {
    fn drop(&mut self) {
        self.0.leave();
    }
}

impl Live {
    /// A page that nobody watches yet, and what passes by for its painter.
    pub fn new(config: &Config) -> (Self, mpsc::Receiver<Note>) {
        let (feed, passed) = Feed::new();
        let made_here = if config.recording.enabled { config.diagnosis.directory.as_path() } else { Path::new("") };
        let reports = Reports::new(&[&config.http.reports, made_here]);
        (Self { feed, reports, pictures: Pictures::default(), desk: Arc::new(Desk::new()), watchers_max: config.http.watchers_max }, passed)
    }

    /// Starts the thread that makes the updates. Where the system refuses one, the page stays without them.
    pub fn start(&self, edge: &Edge, clock: MonotonicClock, recorder: Option<Arc<Recorder>>, passed: mpsc::Receiver<Note>) {
        let painter = Painter {
            engine: edge.engine.clone(),
            predictor: Arc::clone(&edge.predictor),
            presence: edge.presence.clone(),
            clock,
            recorder,
            reports: self.reports.clone(),
            desk: Arc::clone(&self.desk),
            feed: self.feed.clone(),
            passed,
        };
        if let Err(error) = painter.start() {
            tracing::error!(%error, "the live page has no thread and shows nothing");
        }
    }

    /// Ends the thread.
    pub fn stop(&self) {
        self.desk.stop();
    }

    fn enter(&self) -> Option<Place> {
        self.desk.enter(self.watchers_max).then(|| Place(Arc::clone(&self.desk)))
    }
}

/// What goes to a page.
#[derive(Clone, Debug)]
enum Message {
    /// Everything.
    Whole(Arc<Update>),
    /// What is new since the update before.
    Fresh(Arc<Update>),
    /// So many updates were lost; everything follows.
    Lost(u64),
    /// The service ends.
    Stopped,
}

impl Message {
    fn event(&self) -> Event {
        let event = Event::default();
        match self {
            Self::Whole(update) => event.event("whole").data(update.whole.as_deref().unwrap_or_default()),
            Self::Fresh(update) => event.event("fresh").data(&update.fresh),
            Self::Lost(updates) => event.event("lost").data(format!("{{\"updates\":{updates}}}")),
            Self::Stopped => event.event("stopped").data("{}"),
        }
    }
}

/// The stream.
pub(crate) async fn events(State(state): State<HttpState>) -> Response {
    let Some(place) = state.live.enter() else {
        let reason = format!("{} pages are open, the limit `http.watchers_max`; close one", state.live.watchers_max);
        return (StatusCode::SERVICE_UNAVAILABLE, reason).into_response();
    };
    let (sender, receiver) = mpsc::channel(1);
    let stop = stopped(state.edge.stopping.clone());
    tokio::spawn(async move { watch(&place.0, stop, sender).await });
    let events = ReceiverStream::new(receiver).map(|message: Message| Ok::<_, Infallible>(message.event()));
    Sse::new(events).keep_alive(KeepAlive::default()).into_response()
}

/// Hands updates to a page until it leaves or reads no more, or the service stops.
async fn watch(desk: &Desk, stop: impl Future<Output = ()>, page: mpsc::Sender<Message>) {
    let mut updates = desk.subscribe();
    desk.ask_whole();
    let mut is_behind = true;
    tokio::pin!(stop);
    loop {
        let update = tokio::select! {
            update = updates.recv() => update,
            () = page.closed() => return,
            () = &mut stop => {
                let _ = page.try_send(Message::Stopped);
                return;
            }
        };
        let message = match update {
            Ok(update) if !is_behind => Message::Fresh(update),
            Ok(update) if update.whole.is_some() => {
                is_behind = false;
                Message::Whole(update)
            }
            Ok(_) => {
                desk.ask_whole();
                continue;
            }
            Err(RecvError::Lagged(lost)) => {
                is_behind = true;
                desk.ask_whole();
                Message::Lost(lost)
            }
            Err(RecvError::Closed) => return,
        };
        // Meanwhile the updates go on without this page.
        tokio::select! {
            sent = tokio::time::timeout(STALLED, page.send(message)) => if !matches!(sent, Ok(Ok(()))) { return },
            () = &mut stop => return,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn property_a_page_that_did_not_read_is_told_and_begins_anew() {
        let desk = Arc::new(Desk::new());
        let (sender, mut page) = mpsc::channel(1);
        let watching = tokio::spawn({
            let desk = Arc::clone(&desk);
            async move { watch(&desk, std::future::pending(), sender).await }
        });
        let publish = |i: usize| {
            let whole = desk.take_whole_wanted().then(|| format!("all {i}"));
            desk.publish(Update { fresh: format!("new {i}"), whole });
        };
        tokio::task::yield_now().await;
        // Nobody reads: a hundred updates are published all the same.
        for i in 0..100 {
            publish(i);
            tokio::task::yield_now().await;
        }
        let mut heard = Vec::new();
        for i in 100..120 {
            while let Ok(message) = page.try_recv() {
                heard.push(message);
                tokio::task::yield_now().await;
            }
            publish(i);
            tokio::task::yield_now().await;
        }
        let first = heard.first().expect("the page is served");
        assert!(matches!(first, Message::Whole(update) if update.whole.as_deref() == Some("all 0")), "{first:?}");
        let at = heard.iter().position(|message| matches!(message, Message::Lost(lost) if *lost > 80)).expect("it is told");
        let numbers = heard[at + 1..].iter().map(|message| match message {
            Message::Whole(update) => update.whole.clone().expect("it is whole"),
            Message::Fresh(update) => update.fresh.clone(),
            other => panic!("{other:?}"),
        });
        let numbers: Vec<String> = numbers.collect();
        assert!(numbers[0].starts_with("all ") && numbers.len() > 5, "{numbers:?}");
        let number = |text: &str| text[4..].parse::<usize>().expect("a number");
        assert!(numbers.windows(2).all(|pair| pair[1].starts_with("new ") && number(&pair[1]) == number(&pair[0]) + 1), "{numbers:?}");
        drop(page);
        publish(120);
        watching.await.expect("it ends when the page leaves");
    }
}
