//! Keys of a fleet in etcd, all below one prefix:
//!
//! ```text
//! <prefix>/live/owner/<session>     who has the session: a Server, under the owner's lease; its create revision is the epoch
//! <prefix>/live/want/<session>      who asks the owner for it, under the asker's lease
//! <prefix>/live/map/<map>           hash, number of parts and version of the newest map
//! <prefix>/live/member/<lease>      a server that is there: a Member, under its lease
//! <prefix>/session/<session>        the session's image
//! <prefix>/part/<map>/<hash>/<n>    bytes of a map, in order
//! ```
//!
//! Everything below `live` is watched by every server; it is small. Names have no `/` in them.

/// Makes the keys.
#[derive(Clone, Debug)]
pub(crate) struct Keys {
    prefix: String,
}

/// What a key below `live` is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Topic<'a> {
    Owner(&'a str),
    Want(&'a str),
    Map(&'a str),
    Member(i64),
}

impl Keys {
    pub fn new(prefix: &str) -> Self {
        Self { prefix: prefix.into() }
    }

    pub fn live(&self) -> String {
        format!("{}/live/", self.prefix)
    }

    pub fn owner(&self, session: &str) -> String {
        format!("{}/live/owner/{session}", self.prefix)
    }

    pub fn want(&self, session: &str) -> String {
        format!("{}/live/want/{session}", self.prefix)
    }

    pub fn map(&self, map: &str) -> String {
        format!("{}/live/map/{map}", self.prefix)
    }

    pub fn member(&self, lease: i64) -> String {
        format!("{}/live/member/{lease:x}", self.prefix)
    }

    /// Before the images of all sessions.
    pub fn sessions(&self) -> String {
        format!("{}/session/", self.prefix)
    }

    pub fn session(&self, session: &str) -> String {
        format!("{}{session}", self.sessions())
    }

    /// The session whose image stands under a key.
    pub fn session_name<'a>(&self, key: &'a [u8]) -> Option<&'a str> {
        std::str::from_utf8(key).ok()?.strip_prefix(&self.sessions())
    }

    /// Before all parts of one content of a map; without a hash, of all its contents.
    pub fn parts(&self, map: &str, hash: Option<&str>) -> String {
        hash.map_or_else(|| format!("{}/part/{map}/", self.prefix), |hash| format!("{}/part/{map}/{hash}/", self.prefix))
    }

    /// One part; keys sort as their numbers do.
    pub fn part(&self, map: &str, hash: &str, number: usize) -> String {
        format!("{}{number:06}", self.parts(map, Some(hash)))
    }

    /// What a key is about; `None` for one that is not below `live` or that a newer server knows.
    pub fn topic<'a>(&self, key: &'a [u8]) -> Option<Topic<'a>> {
        let key = std::str::from_utf8(key).ok()?.strip_prefix(&self.prefix)?.strip_prefix("/live/")?;
        match key.split_once('/')? {
            ("owner", session) => Some(Topic::Owner(session)),
            ("want", session) => Some(Topic::Want(session)),
            ("map", map) => Some(Topic::Map(map)),
            ("member", lease) => i64::from_str_radix(lease, 16).ok().map(Topic::Member),
            _ => None,
        }
    }
}

/// The first key behind all that begin with this.
pub(super) fn behind(prefix: &str) -> Vec<u8> {
    let mut end = prefix.as_bytes().to_vec();
    // Prefixes end with `/`, which is below the largest byte.
    if let Some(last) = end.last_mut() {
        *last += 1;
    }
    end
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_keys_are_read_back() {
        let keys = Keys::new("a/b");
        assert_eq!(keys.topic(keys.owner("t-7").as_bytes()), Some(Topic::Owner("t-7")));
        assert_eq!(keys.topic(keys.want("t-7").as_bytes()), Some(Topic::Want("t-7")));
        assert_eq!(keys.topic(keys.map("hill").as_bytes()), Some(Topic::Map("hill")));
        assert_eq!(keys.topic(keys.member(255).as_bytes()), Some(Topic::Member(255)));
        for other in [keys.session("t-7"), keys.part("hill", "ab", 3), "a/bc/live/owner/x".into(), String::new()] {
            assert_eq!(keys.topic(other.as_bytes()), None, "{other}");
        }
        assert_eq!(keys.session_name(keys.session("t-7").as_bytes()), Some("t-7"));
        assert_eq!(keys.session_name(keys.owner("t-7").as_bytes()), None);
        assert_eq!(behind("a/"), b"a0");
        assert!(keys.part("m", "h", 9) < keys.part("m", "h", 10));
    }
}
