//! A measurement on its way from the network into the engine, whatever its form was.

use nesam_engine::{Command, EngineError, MeasureAnswer, Measurement};

use crate::call::{measured, unmeasured};
use crate::cluster::{Brought, Standing};
use crate::grpc::Edge;

/// Who sent it, to which session, and who hears what became of it.
pub struct Arrival {
    /// The server.
    pub edge: Edge,
    /// Session that it is for.
    pub session: String,
    /// Vehicle that rights are given by: the session is whatever the sender says.
    pub vehicle: String,
    /// Run that it was meant for; 0 = any.
    pub run: u64,
    /// Hears the answer, once, on the engine's thread or on that of the caller.
    pub answer: Box<dyn FnOnce(Result<MeasureAnswer, EngineError>) + Send>,
}

impl Arrival {
    /// Hands over what was read. Runs on a thread of Zenoh, so nothing is waited for here.
    ///
    /// Every server hears every measurement: the owner of the session takes it, the others pass over it, and where there is no owner they race for the
    /// session; what was not answered meanwhile the vehicle sends again.
    pub fn take(self, read: Result<Measurement, EngineError>) {
        let Some(ours) = (if read.is_ok() { self.if_ours() } else { Some(self) }) else { return };
        // The run of another vehicle's session is not told either: the engine refuses that one.
        let checked = read.and_then(|measurement| {
            if ours.is_foreign() { Ok(measurement) } else { ours.edge.check_run(&ours.session, ours.run).map(|()| measurement) }
        });
        match checked {
            Ok(measurement) => ours.submit(measurement),
            Err(error) => ours.refuse(error),
        }
    }

    fn submit(self, measurement: Measurement) {
        let Self { edge, session, vehicle, answer, .. } = self;
        let command = Command::Measure { session, vehicle: Some(vehicle.clone()), measurement };
        let mut submission = edge.engine.submission(command, move |reply| answer(measured(reply)));
        submission.share = Some(vehicle.into());
        edge.engine.handle().submit(submission);
    }

    /// Answers a measurement that never reaches the engine; where there is room the session is read in its place, so that the answer tells where it stands.
    fn refuse(self, error: EngineError) {
        let Self { edge, session, vehicle, answer, .. } = self;
        if !edge.engine.has_room() {
            return answer(Err(error));
        }
        edge.engine.handle().submit(edge.engine.submission(Command::Get { session }, move |reply| {
            answer(Err(unmeasured(error, Some(&vehicle), reply)));
        }));
    }

    /// Itself, where this server answers.
    fn if_ours(self) -> Option<Self> {
        let Some(cluster) = self.edge.cluster.clone() else { return Some(self) };
        match cluster.standing(&self.session) {
            Standing::Here => return Some(self),
            Standing::Lost => {
                let runtime = self.edge.runtime.clone();
                runtime.spawn(async move {
                    let found = cluster.search(&self.session, &self.vehicle, self.edge.stream_budget()).await;
                    if let Some(Brought::Nowhere) = found {
                        (self.answer)(Err(EngineError::UnknownSession { session: self.session }));
                    }
                });
            }
            _ => {}
        }
        None
    }

    /// See [`Directory::is_foreign`](crate::access::Directory::is_foreign).
    fn is_foreign(&self) -> bool {
        self.edge.access.directory.is_foreign(&self.session, &self.vehicle)
    }
}
