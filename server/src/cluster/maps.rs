//! Maps that servers share: whoever takes a session brings its map, and a newer one replaces what is held.

use nesam_engine::EngineError;
use nesam_model::bundle::sha256_hex;
use tonic::Status;

use super::record::{MapHead, json, of_json, session_of};
use super::{Cluster, delete, delete_all, get, get_all, get_keys, put, written};
use crate::convert::{session_image, to_status};
use crate::store::{map_of, map_version};

/// Size of a part, bytes; etcd takes requests of 1.5 MiB.
const PART_BYTES: usize = 512 << 10;
/// Images of sessions that are read at once.
const IMAGES_AT_ONCE: usize = 32;
/// Attempts at a map that somebody else writes at the same time.
const ATTEMPTS: usize = 5;
/// Longest wait for the engine.
const PUT: std::time::Duration = std::time::Duration::from_secs(10);

impl Cluster {
    /// Puts the newest content of a map into the engine, unless it is there, and gives the hash of what the engine holds.
    pub(super) async fn have_map(&self, map: &str) -> Result<String, Status> {
        let keys = &self.0.keys;
        for _ in 0..ATTEMPTS {
            let held = self.0.engine.get_map(map, PUT).await.ok().map(|held| held.hash().to_string());
            let Some((head, _)) = self.map_head(map).await? else {
                return held.ok_or_else(|| Status::failed_precondition(format!("map `{map}` is held by no server")));
            };
            if let Some(held) = held.filter(|_| self.lock().maps.get(map) == Some(&head.sha256)) {
                return Ok(held);
            }
            let parts = self.0.etcd.all(vec![get_all(&keys.parts(map, Some(&head.sha256)))]).await?.read.into_iter().flatten();
            let parts: Vec<_> = parts.map(|found| found.value).collect();
            let bytes = parts.concat();
            if parts.len() != head.parts || sha256_hex(&bytes) != head.sha256 {
                // Replaced while it was read.
                continue;
            }
            let limits = self.0.engine.handle().limits().clone();
            let read = tokio::task::spawn_blocking(move || map_of(&bytes, &limits)).await;
            let read = read.unwrap_or_else(|_| Err("reading it panicked; this is a bug".into()));
            let read = read.map_err(|reason| Status::data_loss(format!("map `{map}` as etcd holds it: {reason}")))?;
            let hash = read.hash().to_string();
            let hash = match self.0.engine.put_map(read.into(), None, PUT).await {
                Ok(_) => hash,
                // A newer one was put here a moment ago.
                Err(EngineError::MapExists { .. }) => self.0.engine.get_map(map, PUT).await.map_err(to_status)?.hash().to_string(),
                Err(error) => return Err(to_status(error)),
            };
            // After the engine has it: what this server knows and does not hold may be removed.
            self.lock().maps.insert(map.into(), head.sha256);
            return Ok(hash);
        }
        Err(Status::unavailable(format!("map `{map}` changes faster than it can be read; ask again")))
    }

    /// Brings a map here if etcd has it.
    ///
    /// # Errors
    /// What etcd says, or what is wrong with the map.
    pub async fn bring_map(&self, map: &str) -> Result<(), Status> {
        match self.map_head(map).await? {
            Some(_) => self.have_map(map).await.map(drop),
            None => Ok(()),
        }
    }

    /// Puts a newer content of a map into the engine if an older one is held.
    pub(super) async fn renew_map(self, map: String, sha256: String) {
        let old = self.lock().maps.get(&map).is_some_and(|held| *held != sha256);
        if old && let Err(status) = self.have_map(&map).await {
            tracing::warn!(map, reason = status.message(), "map not renewed");
        }
    }

    /// Takes note of a map that is not in etcd any more, because another server has deleted it. It goes here too, but where a session drives on it: the map of a
    /// session that moves must be there, so it is written again.
    pub(super) async fn lose_map(self, map: String) {
        let known = self.lock().maps.contains_key(&map);
        // Nothing is lost where somebody has written it again meanwhile.
        if !known || matches!(self.map_head(&map).await, Ok(Some(_))) {
            return;
        }
        self.lock().maps.remove(&map);
        let used = matches!(self.0.engine.delete_map(&map, PUT).await, Err(EngineError::MapInUse { .. }));
        self.0.keeper.lost_map(&map);
        tracing::info!(map, used, "map deleted by another server; it is written again where it is used");
    }

    /// A session that drives on a map, on whatever server it is, or on none. Reads the images of all sessions; one that has begun a moment ago has none yet.
    ///
    /// # Errors
    /// What etcd says.
    pub async fn map_user(&self, map: &str) -> Result<Option<String>, Status> {
        let keys = &self.0.keys;
        let read = self.0.etcd.all(vec![get_keys(&keys.sessions())]).await?.read;
        let names: Vec<&str> = read.iter().flatten().filter_map(|found| keys.session_name(&found.key)).collect();
        for some in names.chunks(IMAGES_AT_ONCE) {
            let read = self.0.etcd.all(some.iter().map(|name| get(&keys.session(name))).collect()).await?.read;
            let found = some.iter().zip(&read).find(|(name, found)| found.iter().any(|found| drives_on(name, &found.value, map)));
            if let Some((name, _)) = found {
                return Ok(Some((*name).to_owned()));
            }
        }
        Ok(None)
    }

    /// Writes a map unless a newer version stands there; of two of one version the last writer's stands.
    ///
    /// # Errors
    /// What etcd says.
    pub(crate) async fn write_map(&self, map: &str, bytes: &[u8]) -> Result<(), Status> {
        let (keys, sha256) = (&self.0.keys, sha256_hex(bytes));
        let parts = bytes.chunks(PART_BYTES);
        let head = MapHead { sha256: sha256.clone(), parts: parts.len(), version: map_version(bytes) };
        for _ in 0..ATTEMPTS {
            let before = self.map_head(map).await?;
            if before.is_some() {
                // Before it is written, so that the watch finds nothing new in it. A map that is not there yet is nothing that could be lost.
                self.lock().maps.insert(map.into(), sha256.clone());
            }
            let same = before.as_ref().is_some_and(|(before, _)| before.sha256 == head.sha256);
            // Whoever removed a map meanwhile took the parts of one that was not named yet with it.
            if same && self.count_parts(map, &sha256).await? == head.parts {
                return Ok(());
            }
            if let Some((newer, _)) = before.as_ref().filter(|(before, _)| before.version > head.version) {
                tokio::spawn(self.clone().renew_map(map.into(), newer.sha256.clone()));
                return Ok(());
            }
            for (number, part) in parts.clone().enumerate() {
                self.0.etcd.all(vec![put(&keys.part(map, &sha256, number), part.to_vec(), 0)]).await?;
            }
            let revision = before.as_ref().map_or(0, |(_, revision)| *revision);
            let mut then = vec![put(&keys.map(map), json(&head), 0)];
            then.extend(before.filter(|_| !same).map(|(before, _)| delete_all(&keys.parts(map, Some(&before.sha256)))));
            // Whether it holds, and is whole, is seen next.
            self.0.etcd.transaction(vec![written(&keys.map(map), revision)], then).await?;
        }
        Err(Status::aborted(format!("map `{map}` is written by others all the time")))
    }

    /// Parts of one content of a map that are there.
    async fn count_parts(&self, map: &str, sha256: &str) -> Result<usize, Status> {
        let parts = self.0.etcd.all(vec![get_keys(&self.0.keys.parts(map, Some(sha256)))]).await?.read;
        Ok(parts.into_iter().flatten().count())
    }

    /// Removes a map, if what stands there is what this server has read or written last, the engine has not got it again meanwhile, and no session drives on it:
    /// another server may have written it again after it was lost.
    ///
    /// # Errors
    /// What etcd says.
    pub(crate) async fn remove_map(&self, map: &str) -> Result<(), Status> {
        let keys = &self.0.keys;
        if self.0.engine.get_map(map, PUT).await.is_ok() || self.map_user(map).await?.is_some() {
            return Ok(());
        }
        let known = self.lock().maps.get(map).cloned();
        if let Some((head, revision)) = self.map_head(map).await?
            && known == Some(head.sha256)
        {
            let removed = vec![delete(&keys.map(map)), delete_all(&keys.parts(map, None))];
            self.0.etcd.transaction(vec![written(&keys.map(map), revision)], removed).await?;
        }
        self.lock().maps.remove(map);
        Ok(())
    }

    /// What etcd says of a map, and the revision at which it was said.
    async fn map_head(&self, map: &str) -> Result<Option<(MapHead, i64)>, Status> {
        let read = self.0.etcd.all(vec![get(&self.0.keys.map(map))]).await?.read;
        let Some(found) = read.into_iter().flatten().next() else { return Ok(None) };
        let head = of_json(&found.value).ok_or_else(|| Status::data_loss(format!("what etcd holds of map `{map}` is no map")))?;
        Ok(Some((head, found.mod_revision)))
    }
}

/// Whether the session whose image this is drives on a map.
fn drives_on(session: &str, image: &[u8], map: &str) -> bool {
    let image = session_of(session, image).and_then(|stored| session_image(&stored.image).ok());
    image.and_then(|image| image.map).is_some_and(|(id, _)| id == map)
}
