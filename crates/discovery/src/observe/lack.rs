//! What drives lack by which the states change that they are predicted from, or the ground under them. What else they lack is compared in fewer channels alone.

use nesam_evaluation::DriveMaps;
use nesam_physics::effects::Layer;
use nesam_trajectories::Trajectory;

use crate::candidates::Candidate;

/// What the ground is told by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Ground {
    /// A map.
    Mapped,
    /// Nothing: it is level, under a vehicle that rolls and pitches as measured.
    Level,
    /// Nothing, under a vehicle whose roll and pitch nobody measured either.
    Untilted,
}

const GROUNDS: [(Ground, &str); 3] = [(Ground::Mapped, ""), (Ground::Level, "-level"), (Ground::Untilted, "-untilted")];

/// What at least one of some drives lacks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lack {
    velocity: bool,
    yaw_rate: bool,
    ground: Ground,
}

impl Lack {
    /// What some drives on these maps lack.
    pub fn of(drives: &[Trajectory], maps: &DriveMaps) -> Self {
        let any = |lacks: &dyn Fn(&Trajectory) -> bool| drives.iter().any(lacks);
        let untilted = any(&|drive| !(drive.measured.attitude[0] && drive.measured.attitude[1]));
        let ground = match (untilted, maps.iter().all(Option::is_some)) {
            (true, _) => Ground::Untilted,
            (false, false) => Ground::Level,
            (false, true) => Ground::Mapped,
        };
        Self {
            velocity: any(&|drive| !drive.measured.linear_velocity),
            yaw_rate: any(&|drive| !drive.measured.angular_velocity[2]),
            ground,
        }
    }

    /// This and everything beyond it, this first.
    pub fn and_more(self) -> Vec<Self> {
        let of = |least: bool| [false, true].into_iter().filter(move |lacks| *lacks || !least);
        let grounds = || GROUNDS.iter().map(|g| g.0).filter(|ground| *ground >= self.ground);
        of(self.velocity)
            .flat_map(|velocity| {
                of(self.yaw_rate).flat_map(move |yaw_rate| grounds().map(move |ground| Self { velocity, yaw_rate, ground }))
            })
            .collect()
    }

    /// Whether drives that lack this cannot show an effect: of a sensor that is not there, or of forces, soils and maps where nothing tells of the slopes, which act as
    /// they do.
    pub(crate) fn hides(self, candidate: &Candidate) -> bool {
        let sensor = match candidate.id() {
            "gyro_bias" | "gyro_scale" => self.yaw_rate,
            "velocity_scale" => self.velocity,
            _ => false,
        };
        sensor || !self.mapped() && matches!(candidate.layer(), Layer::Force | Layer::Soil | Layer::Map)
    }

    /// Whether the ground is told by a map.
    pub fn mapped(self) -> bool {
        self.ground == Ground::Mapped
    }

    /// A drive as if it lacked this; what it then does not measure of its velocities is estimated in hindsight.
    pub fn seen(&self, drive: &Trajectory) -> Trajectory {
        let mut seen = drive.clone();
        seen.measured.linear_velocity &= !self.velocity;
        if self.yaw_rate {
            seen.measured.angular_velocity = [false; 3];
        }
        if self.ground == Ground::Untilted {
            seen.measured.height = false;
            seen.measured.attitude = [false, false, seen.measured.attitude[2]];
            for state in &mut seen.states {
                state.position_m[2] = 0.0;
                (state.attitude_rad[0], state.attitude_rad[1]) = (0.0, 0.0);
            }
        }
        seen.in_hindsight()
    }

    /// What tells arrays of a way of looking apart.
    pub fn suffix(&self) -> String {
        let named = |lacks: bool, name: &'static str| if lacks { name } else { "" };
        let ground = GROUNDS.iter().find(|g| g.0 == self.ground).map_or("", |g| g.1);
        [named(self.velocity, "-velocity"), named(self.yaw_rate, "-yaw_rate"), ground].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: of a sensor that is not there nothing is asked, nor of forces where nobody knows the slopes. Method: a car that lacks one thing at a time.
    #[test]
    fn analytic_what_is_not_there_is_not_asked() {
        let catalogue = crate::candidates::catalogue(&[]);
        let hides = |lack: Lack, id: &str| lack.hides(catalogue.iter().find(|c| c.id() == id).unwrap());
        let all = Lack { velocity: false, yaw_rate: false, ground: Ground::Mapped };
        let [slow, straight, level] =
            [Lack { velocity: true, ..all }, Lack { yaw_rate: true, ..all }, Lack { ground: Ground::Level, ..all }];
        for (lack, hidden) in [
            (all, [false; 4]),
            (slow, [true, false, false, false]),
            (straight, [false, true, false, false]),
            (level, [false, false, true, false]),
        ] {
            let ids = ["velocity_scale", "gyro_bias", "tow", "steering_offset"];
            assert_eq!(ids.map(|id| hides(lack, id)), hidden, "{lack:?}");
        }
    }

    /// Goal: of drives that lack something themselves, what lacks more is looked at, each once and by a name of its own. Method: a car with all and a map, and a robot without
    /// velocities and map.
    #[test]
    fn analytic_every_way_of_lacking_more_is_looked_at_once() {
        let all = Lack { velocity: false, yaw_rate: false, ground: Ground::Mapped };
        let looks = all.and_more();
        assert_eq!((looks.len(), looks[0]), (12, all));
        let mut names: Vec<String> = looks.iter().map(Lack::suffix).collect();
        assert_eq!((names[0].as_str(), names[11].as_str()), ("", "-velocity-yaw_rate-untilted"));
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 12);
        let robot = Lack { velocity: true, yaw_rate: false, ground: Ground::Level };
        assert_eq!(robot.and_more().len(), 4);
        // The first of what a car without a yaw rate lacks that is known of the robot is what both lack.
        let car = Lack { yaw_rate: true, ..all };
        let known = robot.and_more();
        let first = car.and_more().into_iter().find(|look| known.contains(look));
        assert_eq!(first, Some(Lack { yaw_rate: true, ..robot }));
    }
}
