//! How rmw_zenoh puts the graph of ROS 2 on Zenoh: a key for each topic, a liveliness token for each node, publisher and subscription, and an attachment for
//! each message (documentation of rmw_zenoh, `design.md`).

use crate::messages::MessageType;

/// What stands in place of the hash of a type where a distribution knows none (Humble).
const NO_HASH: &str = "TypeHashNotSupported";
/// Quality of service of everything here as tokens have it: reliable, volatile, the last ten. What is as usual is left empty.
const QOS: &str = "::,10:,:,:,,";

/// Checks the absolute name of a topic or of a namespace: parts of letters, digits and underscores that begin with no digit, each after a slash.
///
/// # Errors
/// What is wrong, in words.
pub fn check_name(name: &str) -> Result<(), String> {
    let Some(parts) = name.strip_prefix('/') else { return Err(format!("`{name}` does not begin with /")) };
    let sound = |part: &str| {
        !part.is_empty() && !part.starts_with(|c: char| c.is_ascii_digit()) && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    match parts.split('/').find(|part| !sound(part)) {
        None => Ok(()),
        Some(part) => Err(format!("`{name}` is no name of ROS: its part `{part}` is not letters, digits and _ that begin with no digit")),
    }
}

/// The name with every character that ROS does not take in place of an underscore; one before a leading digit.
pub fn sound_name(name: &str) -> String {
    let sound: String = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if sound.starts_with(|c: char| c.is_ascii_digit()) { format!("_{sound}") } else { sound }
}

/// A domain of ROS 2 whose nodes use rmw_zenoh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Domain {
    /// `ROS_DOMAIN_ID`.
    pub id: u32,
    /// Whether its distribution hashes types (Iron and later).
    pub hashes_types: bool,
}

/// A node of this process: a session of Zenoh and the name of the node.
#[derive(Clone, Debug)]
pub struct Node {
    /// Where it is.
    pub domain: Domain,
    /// Id of the session of Zenoh, hexadecimal.
    pub session: String,
    /// Absolute name.
    pub name: String,
}

/// Which end of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// It sends.
    Publisher,
    /// It receives.
    Subscription,
}

impl Domain {
    /// Key on which messages of a topic are sent.
    pub fn key(&self, topic: &str, kind: MessageType) -> String {
        format!("{}/{}", self.key_of_topic(topic, kind), self.hash(kind))
    }

    /// Key expression of a topic whatever the hash of its type: machines of all distributions.
    pub fn key_of_any_version(&self, topic: &str, kind: MessageType) -> String {
        format!("{}/*", self.key_of_topic(topic, kind))
    }

    /// Key expression of all tokens.
    pub fn tokens(&self) -> String {
        format!("@ros2_lv/{}/**", self.id)
    }

    fn key_of_topic(&self, topic: &str, kind: MessageType) -> String {
        format!("{}/{}/{}", self.id, topic.trim_matches('/'), dds_name(kind))
    }

    fn hash(&self, kind: MessageType) -> &'static str {
        if self.hashes_types { kind.hash } else { NO_HASH }
    }
}

impl Node {
    /// The token of the node.
    pub fn token(&self) -> String {
        format!("{}/NN/{}", self.entity(0), self.place())
    }

    /// The token of one of its ends; `number` is its own within the session, from 1.
    pub fn end_token(&self, number: u32, end: End, topic: &str, kind: MessageType) -> String {
        let end = match end {
            End::Publisher => "MP",
            End::Subscription => "MS",
        };
        let (entity, place) = (self.entity(number), self.place());
        format!("{entity}/{end}/{place}/{}/{}/{}/{QOS}", mangled(topic), dds_name(kind), self.domain.hash(kind))
    }

    fn entity(&self, number: u32) -> String {
        format!("@ros2_lv/{}/{}/0/{number}", self.domain.id, self.session)
    }

    /// Enclave, namespace and name.
    fn place(&self) -> String {
        let (namespace, name) = self.name.rsplit_once('/').unwrap_or(("", &self.name));
        format!("%/{}/{name}", if namespace.is_empty() { "%".into() } else { mangled(namespace) })
    }
}

/// What goes with a message: its number from 1, when it was sent (ns since 1970), and the 16 bytes that tell its publisher from others.
///
/// As zenoh-ext writes a tuple of two 64-bit numbers and an array: little-endian, the array after its length.
pub fn attachment(number: i64, sent_ns: i64, publisher: [u8; 16]) -> Vec<u8> {
    [&number.to_le_bytes()[..], &sent_ns.to_le_bytes(), &[16], &publisher].concat()
}

/// Name of a type as DDS has it: `nav_msgs::msg::dds_::Odometry_`.
fn dds_name(kind: MessageType) -> String {
    let (package, name) = kind.name.rsplit_once('/').unwrap_or(("", kind.name));
    format!("{}::dds_::{name}_", package.replace('/', "::"))
}

/// A name in a token, where a slash would begin the next part.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{CommandType, ODOMETRY};

    #[test]
    fn published_keys_and_tokens() {
        // Goal: the forms of rmw_zenoh. Method: those that its documentation and machines that run it show, with other names in them.
        let (jazzy, humble) = (Domain { id: 0, hashes_types: true }, Domain { id: 7, hashes_types: false });
        let twist = CommandType::Twist.message();
        assert_eq!(jazzy.key("/cmd_vel", twist), format!("0/cmd_vel/geometry_msgs::msg::dds_::Twist_/{}", twist.hash));
        assert_eq!(humble.key("/a/odom", ODOMETRY), "7/a/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported");
        assert_eq!(jazzy.key_of_any_version("/cmd_vel", twist), "0/cmd_vel/geometry_msgs::msg::dds_::Twist_/*");
        let node = Node { domain: jazzy, session: "abc".into(), name: "/nesam".into() };
        assert_eq!(node.token(), "@ros2_lv/0/abc/0/0/NN/%/%/nesam");
        let end = node.end_token(3, End::Subscription, "/a/cmd_vel", twist);
        assert_eq!(end, format!("@ros2_lv/0/abc/0/3/MS/%/%/nesam/%a%cmd_vel/geometry_msgs::msg::dds_::Twist_/{}/::,10:,:,:,,", twist.hash));
        let deep = Node { domain: humble, name: "/fleet/north/nesam".into(), ..node };
        assert_eq!(deep.token(), "@ros2_lv/7/abc/0/0/NN/%/%fleet%north/nesam");
    }

    #[test]
    fn analytic_names() {
        for name in ["/odom", "/a_1/odometry/filtered", "/_x"] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
        for (name, told) in
            [("odom", "does not begin with /"), ("/a//b", "part ``"), ("/", "part ``"), ("/1a", "part `1a`"), ("/a-b", "part `a-b`")]
        {
            assert!(check_name(name).is_err_and(|reason| reason.contains(told)), "{name}");
        }
        for (name, sound) in [("truck-7.a", "truck_7_a"), ("7", "_7"), ("husky", "husky")] {
            assert_eq!(sound_name(name), sound);
            assert_eq!(check_name(&format!("/{sound}")), Ok(()));
        }
    }

    #[test]
    fn analytic_bytes_of_an_attachment() {
        let bytes = attachment(258, -1, [9; 16]);
        assert_eq!(bytes.len(), 33);
        assert_eq!((&bytes[..3], &bytes[8..16], bytes[16], &bytes[17..]), (&[2u8, 1, 0][..], &[255u8; 8][..], 16, &[9u8; 16][..]));
    }
}
