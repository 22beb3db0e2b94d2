//! The store of several servers: etcd, where every write of a session names the epoch of its owner.

use std::collections::BTreeMap;

use tokio::runtime::Handle;
use tonic::Status;

use super::{Change, Commit, Contents, SessionStore, StoreError, StoredSession};
use crate::cluster::{Cluster, created, delete, put, session_bytes};

/// Sessions of one transaction at most, and bytes; etcd takes 128 operations and 1.5 MiB.
const SESSIONS_MAX: usize = 32;
const BYTES_MAX: usize = 1 << 20;

/// Sessions and maps in etcd. What a commit holds is on the disks of a majority of its members.
pub(crate) struct EtcdStore {
    cluster: Cluster,
    /// Of the server; the keeper's thread waits in it.
    runtime: Handle,
    /// Epochs of the sessions that are about to be read.
    epochs: BTreeMap<String, i64>,
}

/// A session whose owner this server is, as it is to stand in etcd; `None` = it was closed.
struct Write<'a> {
    name: &'a str,
    epoch: i64,
    session: Option<&'a StoredSession>,
}

impl Write<'_> {
    fn weight(&self) -> usize {
        self.session.map_or(0, |session| session.image.len())
    }
}

impl EtcdStore {
    pub fn new(cluster: Cluster, runtime: Handle) -> Self {
        Self { cluster, runtime, epochs: BTreeMap::new() }
    }

    async fn write_all(&self, changes: &[Change]) -> Result<Vec<String>, Status> {
        let (mut writes, mut foreign) = (Vec::new(), Vec::new());
        for change in changes {
            let (name, session) = match change {
                Change::PutMap(map, bytes) => {
                    self.cluster.write_map(map, bytes).await?;
                    continue;
                }
                Change::RemoveMap(map) => {
                    self.cluster.remove_map(map).await?;
                    continue;
                }
                // The other servers of the fleet hold it.
                Change::PutSoil(_) | Change::RemoveSoil(_) => continue,
                // Nothing is read from here at a start.
                Change::SetAside(_) => continue,
                Change::PutSession(session) => (&session.name, Some(session)),
                Change::RemoveSession(name) => (name, None),
            };
            match self.epochs.get(name).copied() {
                Some(epoch) => writes.push(Write { name, epoch, session }),
                None => foreign.push(name.clone()),
            }
        }
        let mut rest = writes.as_slice();
        while !rest.is_empty() {
            let mut bytes = 0;
            let fits = rest.iter().take(SESSIONS_MAX).take_while(|write| {
                bytes += write.weight();
                bytes <= BYTES_MAX
            });
            let (group, others) = rest.split_at(fits.count().max(1));
            rest = others;
            if self.write(group).await? {
                continue;
            }
            // One of them has gone to another server; the others must not wait for it.
            for alone in group {
                if !self.write(std::slice::from_ref(alone)).await? {
                    self.cluster.lose(alone.name, alone.epoch).await;
                    foreign.push(alone.name.into());
                }
            }
        }
        Ok(foreign)
    }

    /// Writes all of a group, or nothing if one of them belongs to another server.
    async fn write(&self, group: &[Write<'_>]) -> Result<bool, Status> {
        let keys = self.cluster.keys();
        let conditions = group.iter().map(|write| created(&keys.owner(write.name), write.epoch)).collect();
        let then = group.iter().flat_map(|write| match write.session {
            Some(session) => vec![put(&keys.session(write.name), session_bytes(session), 0)],
            None => vec![delete(&keys.session(write.name)), delete(&keys.owner(write.name))],
        });
        let held = self.cluster.etcd().transaction(conditions, then.collect()).await?.held;
        if held {
            group.iter().filter(|write| write.session.is_none()).for_each(|write| self.cluster.closed(write.name, write.epoch));
        }
        Ok(held)
    }
}

impl SessionStore for EtcdStore {
    /// Nothing: sessions come when they are asked for.
    fn load(&self) -> Result<Contents, StoreError> {
        Ok(Contents::default())
    }

    fn begin(&mut self, sessions: &[String]) {
        self.epochs = sessions.iter().filter_map(|name| Some((name.clone(), self.cluster.epoch(name)?))).collect();
    }

    fn commit(&mut self, changes: &[Change]) -> Result<Vec<String>, StoreError> {
        self.runtime.clone().block_on(self.commit_in_task(changes))
    }

    fn commit_in_task<'a>(&'a mut self, changes: &'a [Change]) -> Commit<'a> {
        let failed = |status: Status| StoreError::Database { reason: status.message().into() };
        Box::pin(async move { self.write_all(changes).await.map_err(failed) })
    }
}
