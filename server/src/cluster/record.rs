//! What stands under the keys.

use serde::{Deserialize, Serialize};

use super::keys::{Keys, Topic};
use crate::convert::session_image;
use crate::store::StoredSession;

/// Who has a session, or who asks for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Server {
    /// Name of the server.
    pub name: String,
    /// Where it answers gRPC.
    pub address: String,
}

/// A server that is there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Member {
    /// Its name and address.
    #[serde(flatten)]
    pub server: Server,
    /// Name of the bundle that it answers with.
    pub bundle: String,
    /// SHA-256 of that bundle, hexadecimal.
    pub bundle_hash: String,
}

/// The newest content of a map.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct MapHead {
    /// SHA-256 of the bytes, hexadecimal.
    pub sha256: String,
    /// Into how many parts they are cut.
    pub parts: usize,
    /// Version of the map; 0 = written by a server that did not say so.
    #[serde(default)]
    pub version: u64,
}

/// As JSON.
pub(super) fn json(record: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(record).expect("names and numbers serialise; this is a bug")
}

/// From JSON; `None` for something else.
pub(super) fn of_json<T: for<'de> Deserialize<'de>>(bytes: &[u8]) -> Option<T> {
    serde_json::from_slice(bytes).ok()
}

/// A session: when it was saved, big-endian, then its image.
pub(crate) fn session_bytes(session: &StoredSession) -> Vec<u8> {
    [&session.saved_unix_ns.to_be_bytes()[..], &session.image].concat()
}

/// The session in such bytes; `None` where they are too few.
pub(super) fn session_of(name: &str, bytes: &[u8]) -> Option<StoredSession> {
    let (saved, image) = bytes.split_first_chunk::<8>()?;
    Some(StoredSession { name: name.into(), saved_unix_ns: i64::from_be_bytes(*saved), image: image.to_vec() })
}

/// Whether a server knows what stands under a key of etcd that begins with `prefix`, read as it does.
#[must_use]
pub fn knows_record(prefix: &str, key: &[u8], value: &[u8]) -> bool {
    let keys = Keys::new(prefix);
    match keys.topic(key) {
        Some(Topic::Owner(_) | Topic::Want(_)) => of_json::<Server>(value).is_some(),
        Some(Topic::Map(_)) => of_json::<MapHead>(value).is_some(),
        Some(Topic::Member(_)) => of_json::<Member>(value).is_some(),
        None => {
            let session = keys.session_name(key).and_then(|name| session_of(name, value));
            session.is_some_and(|stored| session_image(&stored.image).is_ok())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_sessions_are_read_back() {
        let session = StoredSession { name: "a".into(), saved_unix_ns: -5, image: vec![1, 2, 3] };
        assert_eq!(session_of("a", &session_bytes(&session)), Some(session));
        assert_eq!(session_of("a", &[0; 7]), None);
        assert_eq!(of_json::<Server>(b"{}"), None);
        // As servers wrote it before it had a version.
        let head = of_json::<MapHead>(br#"{"sha256":"ab","parts":2}"#);
        assert_eq!(head, Some(MapHead { sha256: "ab".into(), parts: 2, version: 0 }));
    }
}
