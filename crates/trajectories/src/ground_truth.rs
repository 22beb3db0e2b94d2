//! Ground truth of simulated drives: for evaluation only, never an input of a model.

use nesam_physics::{VehicleState, WHEELS};

use crate::channels::{WHEEL_SUFFIXES, all};
use crate::error::TrajectoryError;
use crate::resample::Grid;
use crate::table::{Numbers, Table};

/// The `gt_` channels of one drive, on the same samples as the drive. Wheels are FL, FR, RL, RR.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundTruth {
    /// Noise-free twins of the measured states.
    pub states: Vec<VehicleState<f64>>,
    /// Mean sinkage over the loaded soil nodes under each wheel, m.
    pub sinkage_mean_m: Vec<[f64; WHEELS]>,
    /// Deepest sinkage of a loaded node under each wheel, m; 0 = in the air.
    pub sinkage_max_m: Vec<[f64; WHEELS]>,
    /// Soil force on each wheel, WORLD frame, instantaneous, N.
    pub wheel_force_n: Vec<[[f64; 3]; WHEELS]>,
    /// Longitudinal slip of each wheel, -.
    pub slip: Vec<[f64; WHEELS]>,
    /// Region of the world under each wheel: a row of the true soil table.
    pub region: Vec<[usize; WHEELS]>,
    /// Noise-free wheel speeds, rad/s.
    pub wheel_speed_rad_s: Vec<[f64; WHEELS]>,
    /// Noise-free road-wheel angles of the front wheels (left, right), rad.
    pub road_wheel_angle_rad: Vec<[f64; 2]>,
    /// Steering actuator output, normalised.
    pub steering_actuator: Vec<f64>,
    /// World z of each wheel centre, m.
    pub wheel_height_m: Vec<[f64; WHEELS]>,
}

/// The `gt_` columns of a samples file.
pub(crate) struct TruthColumns {
    position: [Numbers; 3],
    attitude: [Numbers; 3],
    velocity: [Numbers; 3],
    angular_velocity: [Numbers; 3],
    sinkage_mean: [Numbers; WHEELS],
    sinkage_max: [Numbers; WHEELS],
    force: [[Numbers; WHEELS]; 3],
    slip: [Numbers; WHEELS],
    region: [Numbers; WHEELS],
    wheel_speed: [Numbers; WHEELS],
    road_wheel_angle: [Numbers; 2],
    steering_actuator: [Numbers; 1],
    wheel_height: [Numbers; WHEELS],
}

impl TruthColumns {
    /// Reads all of them; a missing one is an error that names it.
    pub(crate) fn read(table: &Table) -> Result<Self, TrajectoryError> {
        let wheels = |stem: &str| {
            let names = WHEEL_SUFFIXES.map(|wheel| format!("gt_{stem}_{wheel}"));
            all(table, names.each_ref().map(String::as_str))
        };
        Ok(Self {
            position: all(table, ["gt_x", "gt_y", "gt_z"])?,
            attitude: all(table, ["gt_roll", "gt_pitch", "gt_yaw"])?,
            velocity: all(table, ["gt_vbx", "gt_vby", "gt_vbz"])?,
            angular_velocity: all(table, ["gt_wx", "gt_wy", "gt_wz"])?,
            sinkage_mean: wheels("sink_mean")?,
            sinkage_max: wheels("sink_max")?,
            force: [wheels("fx")?, wheels("fy")?, wheels("fz")?],
            slip: wheels("slip")?,
            region: wheels("region")?,
            wheel_speed: wheels("om")?,
            road_wheel_angle: all(table, ["gt_steer_fl", "gt_steer_fr"])?,
            steering_actuator: all(table, ["gt_steer_act"])?,
            wheel_height: wheels("wheel_z")?,
        })
    }

    /// Ground truth of the drive in the given rows, resampled with the grid of the drive.
    pub(crate) fn of(&self, rows: &[usize], grid: &Grid) -> Result<GroundTruth, TrajectoryError> {
        let position = grid.linear(&together(&self.position, rows)?);
        let attitude = grid.angles(&together(&self.attitude, rows)?);
        let velocity = grid.linear(&together(&self.velocity, rows)?);
        let angular = grid.linear(&together(&self.angular_velocity, rows)?);
        let states = (0..position.len()).map(|k| VehicleState {
            position_m: position[k],
            attitude_rad: attitude[k],
            velocity_m_s: velocity[k],
            angular_velocity_rad_s: angular[k],
        });
        let force = [&self.force[0], &self.force[1], &self.force[2]].map(|columns| together(columns, rows));
        let [fx, fy, fz] = force.map(|axis| axis.map(|values| grid.linear(&values)));
        let (fx, fy, fz) = (fx?, fy?, fz?);
        let wheel_force_n = (0..fx.len()).map(|k| core::array::from_fn(|w| [fx[k][w], fy[k][w], fz[k][w]]));
        // Ids have no value in between: they are held, not interpolated.
        let region = grid.held(&together(&self.region, rows)?);
        Ok(GroundTruth {
            states: states.collect(),
            sinkage_mean_m: grid.linear(&together(&self.sinkage_mean, rows)?),
            sinkage_max_m: grid.linear(&together(&self.sinkage_max, rows)?),
            wheel_force_n: wheel_force_n.collect(),
            slip: grid.linear(&together(&self.slip, rows)?),
            region: region.iter().map(|ids: &[f64; WHEELS]| ids.map(|id| id.max(0.0) as usize)).collect(),
            wheel_speed_rad_s: grid.linear(&together(&self.wheel_speed, rows)?),
            road_wheel_angle_rad: grid.linear(&together(&self.road_wheel_angle, rows)?),
            steering_actuator: grid.linear(&together(&self.steering_actuator, rows)?).iter().map(|v| v[0]).collect(),
            wheel_height_m: grid.linear(&together(&self.wheel_height, rows)?),
        })
    }
}

/// N columns as rows of N values; a value that is not finite is an error that names column and row.
pub(crate) fn together<const N: usize>(columns: &[Numbers; N], rows: &[usize]) -> Result<Vec<[f64; N]>, TrajectoryError> {
    let mut out = vec![[0.0; N]; rows.len()];
    for (i, column) in columns.iter().enumerate() {
        for (to, value) in out.iter_mut().zip(column.finite(rows)?) {
            to[i] = value;
        }
    }
    Ok(out)
}
