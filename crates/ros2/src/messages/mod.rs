//! Messages, field by field as the `.msg` files of common_interfaces and ackermann_msgs have them.

mod received;
mod told;

pub use received::{Command, CommandType, Odometry, imu_rates};
pub use told::{DiagnosticArray, DiagnosticStatus, Dimension, Float64MultiArray, Level};

/// A type of messages: its name, and the hash of its definition by which ROS 2 tells versions apart (REP-2016).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageType {
    /// Package, `msg` and name, e.g. `nav_msgs/msg/Odometry`.
    pub name: &'static str,
    /// Hash as in keys, the same from Iron to Kilted.
    pub hash: &'static str,
}

/// `nav_msgs/msg/Odometry`.
pub const ODOMETRY: MessageType =
    MessageType { name: "nav_msgs/msg/Odometry", hash: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0" };
/// `sensor_msgs/msg/Imu`.
pub const IMU: MessageType =
    MessageType { name: "sensor_msgs/msg/Imu", hash: "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b" };
/// `std_msgs/msg/Float64MultiArray`.
pub const FLOAT64_MULTI_ARRAY: MessageType =
    MessageType { name: "std_msgs/msg/Float64MultiArray", hash: "RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f" };
/// `diagnostic_msgs/msg/DiagnosticArray`.
pub const DIAGNOSTIC_ARRAY: MessageType = MessageType {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    hash: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
};
