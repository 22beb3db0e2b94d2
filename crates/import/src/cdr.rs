//! CDR, the encoding of ROS 2 messages: the few types that say how a vehicle moves and what it was told.
//!
//! Little-endian plain CDR (XCDR1) as ROS 2 writes it: four bytes of header, then fields aligned to their size, counted from behind the header
//! (OMG DDSI-RTPS 10.2). Field orders are those of the `.msg` files of common_interfaces and ackermann_msgs.

/// A cursor on one message; `None` = it ends too early or is not such a message.
struct Cdr<'a> {
    body: &'a [u8],
    at: usize,
}

impl<'a> Cdr<'a> {
    fn new(message: &'a [u8]) -> Option<Self> {
        let (header, body) = message.split_at_checked(4)?;
        // 0x0001: plain CDR, little-endian.
        (header[..2] == [0, 1]).then_some(Self { body, at: 0 })
    }

    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.at = self.at.next_multiple_of(N);
        let bytes = self.body.get(self.at..self.at + N)?.try_into().ok()?;
        self.at += N;
        Some(bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn f32(&mut self) -> Option<f64> {
        self.bytes().map(|b| f64::from(f32::from_le_bytes(b)))
    }

    fn numbers<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.bytes()?);
        }
        Some(values)
    }

    fn skip_text(&mut self) -> Option<()> {
        let length = usize::try_from(self.u32()?).ok()?;
        self.at = self.at.checked_add(length).filter(|end| *end <= self.body.len())?;
        Some(())
    }

    /// std_msgs/Header: stamp, ns.
    fn header(&mut self) -> Option<i64> {
        let (seconds, nanoseconds) = (self.u32()? as i32, self.u32()?);
        self.skip_text()?;
        Some(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds))
    }
}

/// nav_msgs/msg/Odometry: pose in its frame, twist in Body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Odometry {
    pub stamp_ns: i64,
    pub position: [f64; 3],
    /// x, y, z, w.
    pub orientation: [f64; 4],
    pub linear: [f64; 3],
    pub angular: [f64; 3],
}

pub(crate) fn odometry(message: &[u8]) -> Option<Odometry> {
    let mut cdr = Cdr::new(message)?;
    let stamp_ns = cdr.header()?;
    cdr.skip_text()?; // child_frame_id
    let (position, orientation) = (cdr.numbers()?, cdr.numbers()?);
    cdr.numbers::<36>()?;
    Some(Odometry { stamp_ns, position, orientation, linear: cdr.numbers()?, angular: cdr.numbers()? })
}

/// sensor_msgs/msg/Imu: stamp in ns, angular velocity.
pub(crate) fn imu(message: &[u8]) -> Option<(i64, [f64; 3])> {
    let mut cdr = Cdr::new(message)?;
    let stamp_ns = cdr.header()?;
    cdr.numbers::<13>()?; // orientation and its covariance
    Some((stamp_ns, cdr.numbers()?))
}

/// geometry_msgs/msg/Twist and TwistStamped: stamp in ns where it has one; speed forward, yaw rate.
pub(crate) fn twist(message: &[u8], stamped: bool) -> Option<(Option<i64>, [f64; 2])> {
    let mut cdr = Cdr::new(message)?;
    let stamp_ns = if stamped { Some(cdr.header()?) } else { None };
    let values: [f64; 6] = cdr.numbers()?;
    Some((stamp_ns, [values[0], values[5]]))
}

/// ackermann_msgs/msg/AckermannDrive and AckermannDriveStamped: stamp in ns where it has one; speed, road-wheel angle.
pub(crate) fn ackermann(message: &[u8], stamped: bool) -> Option<(Option<i64>, [f64; 2])> {
    let mut cdr = Cdr::new(message)?;
    let stamp_ns = if stamped { Some(cdr.header()?) } else { None };
    let (angle, _, speed) = (cdr.f32()?, cdr.f32()?, cdr.f32()?);
    Some((stamp_ns, [speed, angle]))
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
        assert_eq!(twist(&message, false), Some((None, [1.5, -0.25])));
        assert_eq!(twist(&message[..50], false), None, "cut off");
        message[1] = 0;
        assert_eq!(twist(&message, false), None, "big-endian");
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
            let odometry = odometry(&message).expect("an odometry");
            assert_eq!((odometry.stamp_ns, odometry.position, odometry.orientation[3]), (7_000_000_005, [0.0, 1.0, 2.0], 6.0), "{frame}");
            assert_eq!((odometry.linear, odometry.angular), ([43.0, 44.0, 45.0], [46.0, 47.0, 48.0]), "{frame}");
        }
    }
}
