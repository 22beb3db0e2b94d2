//! What machines send: how they move and what they were told.

use super::MessageType;
use crate::cdr::Reader;

/// nav_msgs/msg/Odometry: pose in its frame, twist in the frame of its child.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Odometry {
    /// Instant, ns.
    pub stamp_ns: i64,
    /// Position of the child, m.
    pub position_m: [f64; 3],
    /// Attitude of the child, quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// Velocity in the frame of the child, m/s.
    pub linear_m_s: [f64; 3],
    /// Angular velocity in the frame of the child, rad/s.
    pub angular_rad_s: [f64; 3],
}

impl Odometry {
    /// Reads a message; `None` = it is none.
    pub fn read(message: &[u8]) -> Option<Self> {
        let mut cdr = Reader::new(message)?;
        let stamp_ns = cdr.header()?;
        cdr.skip_text()?; // child_frame_id
        let (position_m, orientation) = (cdr.numbers()?, cdr.numbers()?);
        cdr.numbers::<36>()?;
        Some(Self { stamp_ns, position_m, orientation, linear_m_s: cdr.numbers()?, angular_rad_s: cdr.numbers()? })
    }
}

/// sensor_msgs/msg/Imu: stamp in ns, angular velocity in its frame, rad/s; `None` = it is none.
pub fn imu_rates(message: &[u8]) -> Option<(i64, [f64; 3])> {
    let mut cdr = Reader::new(message)?;
    let stamp_ns = cdr.header()?;
    cdr.numbers::<13>()?; // orientation and its covariance
    Some((stamp_ns, cdr.numbers()?))
}

/// Types of commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandType {
    /// `geometry_msgs/msg/Twist`: speed and yaw rate.
    Twist,
    /// `geometry_msgs/msg/TwistStamped`.
    TwistStamped,
    /// `ackermann_msgs/msg/AckermannDrive`: speed and road-wheel angle.
    Ackermann,
    /// `ackermann_msgs/msg/AckermannDriveStamped`.
    AckermannStamped,
}

/// What a vehicle was told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Command {
    /// Instant, ns; `None` where the type has none.
    pub stamp_ns: Option<i64>,
    /// Speed forward, m/s.
    pub speed_m_s: f64,
    /// Yaw rate, rad/s, or road-wheel angle, rad, positive to the left, as [`CommandType::is_steered`] says.
    pub turn: f64,
}

impl CommandType {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Twist, Self::TwistStamped, Self::Ackermann, Self::AckermannStamped];

    /// The type of that name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.message().name == name)
    }

    /// Name and hash.
    pub const fn message(self) -> MessageType {
        let (name, hash) = match self {
            Self::Twist => ("geometry_msgs/msg/Twist", "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"),
            Self::TwistStamped => {
                ("geometry_msgs/msg/TwistStamped", "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64")
            }
            Self::Ackermann => {
                ("ackermann_msgs/msg/AckermannDrive", "RIHS01_acf287a224a947dd1b0b87d6d76cdb73f497b0237b8fc73be2173b2ebbb82c99")
            }
            Self::AckermannStamped => {
                ("ackermann_msgs/msg/AckermannDriveStamped", "RIHS01_48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf")
            }
        };
        MessageType { name, hash }
    }

    /// Whether it tells a road-wheel angle and not a yaw rate.
    pub fn is_steered(self) -> bool {
        matches!(self, Self::Ackermann | Self::AckermannStamped)
    }

    /// Reads a message of this type; `None` = it is none.
    pub fn read(self, message: &[u8]) -> Option<Command> {
        let mut cdr = Reader::new(message)?;
        let stamp_ns = match self {
            Self::TwistStamped | Self::AckermannStamped => Some(cdr.header()?),
            Self::Twist | Self::Ackermann => None,
        };
        if self.is_steered() {
            let (turn, _, speed_m_s) = (cdr.f32()?, cdr.f32()?, cdr.f32()?);
            return Some(Command { stamp_ns, speed_m_s, turn });
        }
        let [speed_m_s, .., turn]: [f64; 6] = cdr.numbers()?;
        Some(Command { stamp_ns, speed_m_s, turn })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_bytes_of_a_twist() {
        // `ros2 topic pub /cmd_vel geometry_msgs/msg/Twist '{linear: {x: 1.5}, angular: {z: -0.25}}'` on the wire: no padding before doubles.
        let mut message = vec![0, 1, 0, 0];
        for value in [1.5f64, 0.0, 0.0, 0.0, 0.0, -0.25] {
            message.extend(value.to_le_bytes());
        }
        assert_eq!(CommandType::Twist.read(&message), Some(Command { stamp_ns: None, speed_m_s: 1.5, turn: -0.25 }));
        assert_eq!(CommandType::Twist.read(&message[..50]), None, "cut off");
        message[1] = 0;
        assert_eq!(CommandType::Twist.read(&message), None, "big-endian");
    }

    #[test]
    fn analytic_texts_of_any_length_keep_doubles_aligned() {
        for frame in ["", "o", "odom", "base_link", "robot_7/odom"] {
            let mut body: Vec<u8> = [7i32.to_le_bytes(), 5i32.to_le_bytes()].concat();
            let text = |body: &mut Vec<u8>, text: &str| {
                body.resize(body.len().next_multiple_of(4), 0);
                body.extend((text.len() as u32 + 1).to_le_bytes());
                body.extend(text.as_bytes());
                body.push(0);
            };
            text(&mut body, frame);
            text(&mut body, "base");
            body.resize(body.len().next_multiple_of(8), 0);
            (0..85).for_each(|i| body.extend(f64::from(i).to_le_bytes()));
            let message = [vec![0, 1, 0, 0], body].concat();
            let odometry = Odometry::read(&message).expect("an odometry");
            assert_eq!((odometry.stamp_ns, odometry.position_m, odometry.orientation[3]), (7_000_000_005, [0.0, 1.0, 2.0], 6.0), "{frame}");
            assert_eq!((odometry.linear_m_s, odometry.angular_rad_s), ([43.0, 44.0, 45.0], [46.0, 47.0, 48.0]), "{frame}");
        }
    }

    #[test]
    fn analytic_types_are_found_by_their_names() {
        for kind in CommandType::ALL {
            assert_eq!(CommandType::named(kind.message().name), Some(kind));
        }
        assert_eq!(CommandType::named("geometry_msgs/msg/Pose"), None);
    }

    proptest::proptest! {
        #[test]
        fn property_no_bytes_make_a_reader_panic(bytes in proptest::collection::vec(0u8..=255, 0..900), plain in proptest::bool::ANY) {
            let mut message = bytes;
            if plain && message.len() >= 4 {
                message[..4].copy_from_slice(&[0, 1, 0, 0]);
            }
            let _ = (Odometry::read(&message), imu_rates(&message), CommandType::ALL.map(|kind| kind.read(&message)));
        }
    }
}
