//! Whom this server is connected to in the Zenoh network. A peer that has lost its router goes on without it and says nothing.

use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// Routers and peers that are connected. Shared between Zenoh and the metrics.
#[derive(Clone, Debug, Default)]
pub struct Neighbours(Arc<Mutex<Seen>>);

#[derive(Debug, Default)]
struct Seen {
    /// Whether the configuration names somebody to connect to.
    sought: bool,
    /// Routers and peers; `None` = outside of the network.
    connected: Option<[usize; 2]>,
}

impl Neighbours {
    /// Routers and peers that are connected, each with what it is.
    pub fn counts(&self) -> [(&'static str, usize); 2] {
        let [routers, peers] = self.0.lock().ok().and_then(|seen| seen.connected).unwrap_or_default();
        [("router", routers), ("peer", peers)]
    }

    /// Whether somebody is sought and nobody connected.
    pub fn is_alone(&self) -> bool {
        self.0.lock().is_ok_and(|seen| seen.sought && seen.connected.unwrap_or_default() == [0, 0])
    }

    /// Notes whether the configuration names somebody to connect to.
    pub fn seek(&self, sought: bool) {
        if let Ok(mut seen) = self.0.lock() {
            seen.sought = sought;
        }
    }

    /// Looks again and again who is connected, as long as the session lives.
    pub async fn watch(self, session: ::zenoh::Session) {
        while !session.is_closed() {
            self.look(&session).await;
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    async fn look(&self, session: &::zenoh::Session) {
        let about = session.info();
        let connected = [about.routers_zid().await.count(), about.peers_zid().await.count()];
        self.note(Some(connected));
    }

    /// Nobody is connected outside of the network.
    pub fn forget(&self) {
        self.note(None);
    }

    /// Tells the log what has changed.
    fn note(&self, connected: Option<[usize; 2]>) {
        let Ok(mut seen) = self.0.lock() else { return };
        let before = std::mem::replace(&mut seen.connected, connected);
        let sought = seen.sought;
        drop(seen);
        let Some([routers, peers]) = connected.filter(|_| connected != before) else { return };
        match (before.unwrap_or_default(), sought && routers + peers == 0) {
            ([0, 0], true) => tracing::warn!("zenoh reaches nobody in `zenoh.connect` yet; tried again"),
            (_, true) => {
                tracing::error!("zenoh has lost its last router or peer: nobody is heard behind it until one is back; tried again")
            }
            (_, false) => tracing::info!(routers, peers, "zenoh is connected to others than before"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a server that seeks a router is alone until one is connected, again when it is lost, and outside of the network; one that seeks nobody never is.
    #[test]
    fn regress_a_lost_router_is_seen() {
        let neighbours = Neighbours::default();
        assert!(!neighbours.is_alone(), "nobody is sought");
        neighbours.seek(true);
        for (connected, alone) in
            [(None, true), (Some([0, 0]), true), (Some([1, 0]), false), (Some([0, 0]), true), (Some([0, 2]), false), (None, true)]
        {
            neighbours.note(connected);
            let [routers, peers] = connected.unwrap_or_default();
            assert_eq!((neighbours.is_alone(), neighbours.counts()), (alone, [("router", routers), ("peer", peers)]), "{connected:?}");
        }
        neighbours.seek(false);
        assert!(!neighbours.is_alone());
    }

    /// Goal: routers and peers of a session are counted as what they are. Method: sessions of Zenoh on this machine, one of which goes.
    #[tokio::test(flavor = "multi_thread")]
    async fn regress_routers_and_peers_are_counted() {
        let address = {
            let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
            format!("tcp/{}", listener.local_addr().unwrap())
        };
        let open = async |mode: &str, listen: &[&str], connect: &[&str]| {
            let mut config = ::zenoh::Config::default();
            config.insert_json5("mode", &format!("{mode:?}")).unwrap();
            config.insert_json5("scouting/multicast/enabled", "false").unwrap();
            config.insert_json5("listen/endpoints", &format!("{listen:?}")).unwrap();
            config.insert_json5("connect/endpoints", &format!("{connect:?}")).unwrap();
            ::zenoh::open(config).await.unwrap()
        };
        let neighbours = Neighbours::default();
        neighbours.seek(true);
        let router = open("router", &[&address], &[]).await;
        let session = open("peer", &[], &[&address]).await;
        let watching = tokio::spawn(neighbours.clone().watch(session.clone()));
        let eventually = async |expected: [usize; 2]| {
            let begun = std::time::Instant::now();
            while neighbours.counts().map(|(_, count)| count) != expected {
                assert!(begun.elapsed() < Duration::from_secs(60), "{:?}, expected {expected:?}", neighbours.counts());
                tokio::time::sleep(LOOK_EVERY / 10).await;
            }
        };
        eventually([1, 0]).await;
        assert!(!neighbours.is_alone());
        router.close().await.unwrap();
        eventually([0, 0]).await;
        assert!(neighbours.is_alone());
        session.close().await.unwrap();
        watching.await.unwrap();
    }
}
