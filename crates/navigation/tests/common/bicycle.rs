//! A plant that is none of ours: a bicycle on a level floor behind the plant protocol, whose answers a test may spoil.

use std::net::UdpSocket;

use serde_json::{Value, json};

/// From the rear axle ahead to the reference point, m.
const REFERENCE_M: f64 = 1.7;

/// x, y, yaw of the reference point, speed of the rear axle and yaw rate.
#[derive(Default)]
struct Bicycle {
    x_m: f64,
    y_m: f64,
    yaw_rad: f64,
    speed_m_s: f64,
    rate_rad_s: f64,
}

impl Bicycle {
    fn reset(&mut self, request: &Value) {
        let [x_m, y_m, yaw_rad] = ["x_m", "y_m", "yaw_rad"].map(|key| request[key].as_f64().unwrap());
        *self = Self { x_m, y_m, yaw_rad, ..Self::default() };
    }

    fn step(&mut self, request: &Value, habits: Habits) {
        let [wanted_m_s, steering] = ["speed_m_s", "second"].map(|key| request[key].as_f64().unwrap());
        let part_s = habits.step_s / 10.0;
        for _ in 0..10 {
            self.speed_m_s += 2.0 * part_s * (wanted_m_s - self.speed_m_s);
            self.rate_rad_s = self.speed_m_s * (0.37 * habits.left * steering).tan() / 3.3;
            let (sin, cos) = self.yaw_rad.sin_cos();
            let left_m_s = REFERENCE_M * self.rate_rad_s;
            self.x_m += part_s * (self.speed_m_s * cos - left_m_s * sin);
            self.y_m += part_s * (self.speed_m_s * sin + left_m_s * cos);
            self.yaw_rad += part_s * self.rate_rad_s;
        }
    }

    fn state(&self) -> [f64; 12] {
        let left_m_s = REFERENCE_M * self.rate_rad_s;
        [self.x_m, self.y_m, 0.6, 0.0, 0.0, self.yaw_rad, self.speed_m_s, left_m_s, 0.0, 0.0, 0.0, self.rate_rad_s]
    }
}

/// What a plant makes of the protocol.
#[derive(Clone, Copy)]
pub struct Habits {
    /// Time of a step, s.
    pub step_s: f64,
    /// 1 where a positive command is to the left, -1 where it is to the right.
    pub left: f64,
}

/// What it asks for.
pub const RIGHT: Habits = Habits { step_s: 0.1, left: 1.0 };

/// Starts a plant and gives its address. What it sends is what `answer` makes of a request, the number of steps since the last `reset`, and the right reply.
pub fn bicycle(answer: impl FnMut(&Value, usize, Value) -> Vec<String> + Send + 'static) -> String {
    bicycle_with(RIGHT, answer)
}

/// The same, with habits of its own.
pub fn bicycle_with(habits: Habits, mut answer: impl FnMut(&Value, usize, Value) -> Vec<String> + Send + 'static) -> String {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        let (mut vehicle, mut steps) = (Bicycle::default(), 0);
        let (mut last, mut answers) = (None, Vec::new());
        let mut buffer = [0; 2048];
        while let Ok((length, from)) = socket.recv_from(&mut buffer) {
            let request: Value = serde_json::from_slice(&buffer[..length]).unwrap();
            if last.as_ref() != Some(&request["id"]) {
                if request["type"] == "reset" {
                    vehicle.reset(&request);
                    steps = 0;
                } else {
                    vehicle.step(&request, habits);
                    steps += 1;
                }
                answers = answer(&request, steps, json!({ "nesam_plant": 1, "id": request["id"], "state": vehicle.state() }));
                last = Some(request["id"].clone());
            }
            for datagram in &answers {
                socket.send_to(datagram.as_bytes(), from).unwrap();
            }
        }
    });
    address
}
