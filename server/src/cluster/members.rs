//! Which servers there are, and which of them do not go together.

use std::collections::{BTreeMap, BTreeSet};

use tokio::time::Instant;

use super::record::{Member, json};
use super::{Cluster, put};

/// Lengths of a lease for which a server is there before it is held against this one (chosen): the key of a process that ended without a word outlives it by one.
const SETTLED: f64 = 2.0;

/// Servers that the watch has told of, by lease.
#[derive(Debug, Default)]
pub(super) struct Members {
    met: BTreeMap<i64, Met>,
    /// Leases that this server has had.
    own: BTreeSet<i64>,
}

#[derive(Debug)]
struct Met {
    since: Instant,
    member: Member,
    warned: bool,
}

impl Members {
    /// A server is there.
    pub fn note(&mut self, lease: i64, member: Member) {
        if !self.own.contains(&lease) {
            self.met.entry(lease).or_insert(Met { since: Instant::now(), member, warned: false });
        }
    }

    /// One has gone.
    pub fn forget(&mut self, lease: i64) {
        self.met.remove(&lease);
    }

    /// Those are there and no others.
    pub fn keep(&mut self, there: impl Fn(i64) -> bool) {
        self.met.retain(|lease, _| there(*lease));
    }

    /// How many others there are, and how many of them answer with another bundle.
    pub fn others(&self, me: &Member) -> [usize; 2] {
        let another = self.met.values().filter(|met| met.member.bundle_hash != me.bundle_hash);
        [self.met.len(), another.count()]
    }

    /// What does not go together with `me` and was not said before, of those that were there before `until`.
    fn doubts(&mut self, me: &Member, until: Instant) -> Vec<String> {
        let settled = self.met.values_mut().filter(|met| !met.warned && met.since < until);
        settled
            .filter_map(|met| {
                met.warned = true;
                met.member.against(me)
            })
            .collect()
    }
}

impl Member {
    /// Why two servers do not go together.
    fn against(&self, me: &Self) -> Option<String> {
        let Self { server, bundle, bundle_hash, .. } = self;
        let (name, address) = (&server.name, &server.address);
        if *bundle_hash != me.bundle_hash {
            let short = |hash: &str| hash.chars().take(12).collect::<String>();
            return Some(format!(
                "server `{name}` at {address} answers with bundle {bundle} {}, this one with {} {}: no session can move between them; give all servers of a prefix the same bundle",
                short(bundle_hash),
                me.bundle,
                short(&me.bundle_hash)
            ));
        }
        (server.name == me.server.name)
            .then(|| format!("another server is called `{name}` too, at {address}: give each its own cluster.name, to tell them apart"))
    }
}

impl Cluster {
    /// Tells the others under each new lease that this server is there, and says which of them do not go together with it, for ever.
    pub(super) async fn announce(self) {
        let (mut told, lease_length) = (None, self.0.lease.length());
        loop {
            if let Some(lease) = self.0.lease.id().filter(|lease| told != Some(*lease)) {
                self.lock().members.own.insert(lease);
                let there = vec![put(&self.0.keys.member(lease), json(&self.0.me), lease)];
                match self.0.etcd.all(there).await {
                    Ok(_) => told = Some(lease),
                    Err(status) => tracing::debug!(reason = status.message(), "the others do not know of this server yet; told again"),
                }
            }
            let doubts = match Instant::now().checked_sub(lease_length.mul_f64(SETTLED)) {
                Some(until) => self.lock().members.doubts(&self.0.me, until),
                None => Vec::new(),
            };
            for doubt in doubts {
                tracing::warn!("{doubt}");
            }
            tokio::time::sleep(lease_length / 4).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::record::Server;
    use super::*;

    fn member(name: &str, bundle_hash: &str) -> Member {
        let server = Server { name: name.into(), address: "host:1".into() };
        Member { server, bundle: "truck".into(), bundle_hash: bundle_hash.into() }
    }

    /// Goal: servers that do not go together are named once, and neither this one nor what is left of one that ended is. Method: servers of other leases, names and
    /// bundles by hand.
    #[test]
    fn analytic_servers_that_do_not_go_together_are_named_once() {
        let me = member("alpha", "aa");
        let mut members = Members::default();
        let lasting = Instant::now() + std::time::Duration::from_secs(1);
        members.own.insert(10);
        members.note(10, me.clone());
        members.note(11, member("beta", "aa"));
        assert!(members.doubts(&me, lasting).is_empty());
        members.note(12, member("alpha", "aa"));
        members.note(13, member("gamma", "bb"));
        assert_eq!(members.others(&me), [3, 1]);
        assert!(
            members.doubts(&me, Instant::now() - std::time::Duration::from_secs(1)).is_empty(),
            "may be what is left of one that ended"
        );
        let doubts = members.doubts(&me, lasting);
        assert!(doubts[0].contains("cluster.name") && doubts[1].contains("`gamma`") && doubts.len() == 2, "{doubts:?}");
        assert!(members.doubts(&me, lasting).is_empty(), "once");
        members.keep(|lease| lease != 13);
        members.forget(11);
        assert_eq!(members.others(&me), [1, 0]);
    }
}
