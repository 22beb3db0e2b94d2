//! grpc.health.v1: whether calls should come here. It says what `/health` says.

use std::time::Duration;

use tokio::task::JoinHandle;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

use crate::cluster::Cluster;

/// Names under which health is reported; the empty one stands for the whole server.
const NAMES: [&str; 7] =
    ["", "nesam.v1.Sessions", "nesam.v1.Prediction", "nesam.v1.Measurements", "nesam.v1.Terrain", "nesam.v1.Soil", "nesam.v1.Diagnosis"];
/// Time between two looks at the lease (chosen: a part of the shortest lease, 1 s).
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// What the server says of itself. It serves until it stops; one that shares sessions, while it has a lease.
pub(crate) struct Health {
    reporter: HealthReporter,
    following: Option<JoinHandle<()>>,
}

impl Health {
    /// Of a server that serves from now on.
    pub async fn start(cluster: Option<Cluster>) -> Self {
        let reporter = HealthReporter::new();
        report(&reporter, true).await;
        let following = cluster.map(|cluster| tokio::spawn(follow(reporter.clone(), move || cluster.is_leased())));
        Self { reporter, following }
    }

    /// Where it is said.
    pub fn reporter(&self) -> &HealthReporter {
        &self.reporter
    }

    /// Says that the server stops; nothing changes that any more.
    pub async fn stop(self) {
        if let Some(following) = self.following {
            following.abort();
            let _ = following.await;
        }
        report(&self.reporter, false).await;
    }
}

/// Says what `serves` does, of a server that was said to serve.
async fn follow(reporter: HealthReporter, serves: impl Fn() -> bool) {
    let mut said = true;
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let now = serves();
        if now != said {
            report(&reporter, now).await;
            said = now;
        }
    }
}

async fn report(reporter: &HealthReporter, serves: bool) {
    let status = if serves { ServingStatus::Serving } else { ServingStatus::NotServing };
    for name in NAMES {
        reporter.set_service_status(name, status).await;
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use tonic::Request;
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_check_response::ServingStatus as Said;
    use tonic_health::pb::health_server::Health as _;
    use tonic_health::server::HealthService;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(30);

    /// Waits until all names are said to serve, or none is.
    async fn says(service: &HealthService, expected: Said) {
        let said = async {
            for name in NAMES {
                loop {
                    let answer = service.check(Request::new(HealthCheckRequest { service: name.into() })).await.unwrap();
                    if answer.into_inner().status() == expected {
                        break;
                    }
                    tokio::time::sleep(LOOK_EVERY / 4).await;
                }
            }
        };
        tokio::time::timeout(PATIENCE, said).await.unwrap_or_else(|_| panic!("{expected:?} is not said"));
    }

    /// Goal: a server without a lease does not say that it serves, and one that stops does not either. Method: a lease that is lost and found.
    #[tokio::test]
    async fn regress_health_follows_the_lease() {
        let mut health = Health::start(None).await;
        let service = HealthService::from_health_reporter(health.reporter().clone());
        let leased = Arc::new(AtomicBool::new(true));
        let looked = leased.clone();
        health.following = Some(tokio::spawn(follow(health.reporter().clone(), move || looked.load(Ordering::Relaxed))));
        says(&service, Said::Serving).await;
        for (lease, expected) in [(false, Said::NotServing), (true, Said::Serving)] {
            leased.store(lease, Ordering::Relaxed);
            says(&service, expected).await;
        }
        health.stop().await;
        tokio::time::sleep(LOOK_EVERY * 3).await;
        says(&service, Said::NotServing).await;
    }
}
