//! The way of the commands to the actuators: late, lagged, enlarged.

use crate::scalar::Real;
use crate::state::Control;
use crate::vehicle::{SecondCommand, Vehicle};

/// Commands that are kept, so the longest delay in steps: the longest dead time of a card and the longest that an effect adds, 0.6 s each, at steps of 0.1 s.
const SENT: usize = 12;
/// Longest delay that is followed at steps of `dt_s`, s.
pub fn longest_delay_s(dt_s: f64) -> f64 {
    SENT as f64 * dt_s
}

/// Pieces of a step in which lags and a steering actuator advance (chosen: 10 ms of 0.1 s; a held mean within a piece errs in its square).
const PIECES: usize = 10;

/// Commands between sender and actuators. Pairs are (speed m/s, second command in its unit).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CommandPath<T = f64> {
    /// Commands of the last steps, newest first.
    sent: [[T; 2]; SENT],
    /// Outputs of the lags.
    lagged: [T; 2],
    /// Mean speed command that arrived over the last step, m/s.
    pub(crate) speed_over_step_m_s: T,
    /// Position of the steering behind its play, in the unit of the second command.
    pub(crate) play: T,
}

impl<T: Copy> CommandPath<T> {
    /// The same in another scalar.
    pub(crate) fn map<U>(&self, f: impl Fn(T) -> U) -> CommandPath<U> {
        CommandPath {
            sent: self.sent.map(|pair| pair.map(&f)),
            lagged: self.lagged.map(&f),
            speed_over_step_m_s: f(self.speed_over_step_m_s),
            play: f(self.play),
        }
    }
}

impl<T: Real> CommandPath<T> {
    /// After a command that was held for ever.
    pub(crate) fn settled(control: &Control<T>) -> Self {
        let pair = [control.speed_m_s, control.second];
        Self { sent: [pair; SENT], lagged: pair, speed_over_step_m_s: control.speed_m_s, play: control.second }
    }

    /// Advances by a step of `dt_s` under a command and returns the mean of what arrives; `each` is told the second command and the duration of each
    /// piece, s.
    pub(crate) fn advance(&mut self, vehicle: &Vehicle, control: &Control<T>, dt_s: f64, mut each: impl FnMut(T, f64)) -> Control<T> {
        let (terms, delay_s) = (&vehicle.effects.actuator, vehicle.command_delay_s());
        let now = [control.speed_m_s, control.second];
        // Without a lag, and where no steering follows on the way, the mean over the whole step is all that is asked for.
        let pieces = if vehicle.second == SecondCommand::YawRateRadS && terms.lag_s == [0.0; 2] { 1 } else { PIECES };
        let piece_s = dt_s / pieces as f64;
        let mut mean = [T::lit(0.0); 2];
        for piece in 0..pieces {
            let from_s = piece as f64 * piece_s;
            let arrived: [T; 2] = core::array::from_fn(|c| {
                let delayed = self.mean_between(c, now[c], from_s - delay_s[c], piece_s, dt_s);
                self.lag(c, delayed, terms.lag_s[c], piece_s)
            });
            each(arrived[1], piece_s);
            mean = core::array::from_fn(|c| mean[c] + arrived[c] * T::lit(1.0 / pieces as f64));
        }
        self.send(now);
        self.speed_over_step_m_s = mean[0] * T::lit(1.0 + terms.speed_gain);
        Control { speed_m_s: self.speed_over_step_m_s, second: mean[1] }
    }

    /// Follows a step in which a command arrives as it is sent and leaves the steering there, so that a delay, a lag or play that begins afterwards begins with what was
    /// last told.
    #[inline(always)]
    pub(crate) fn pass(&mut self, control: &Control<T>, steering: T) {
        let now = [control.speed_m_s, control.second];
        self.send(now);
        (self.lagged, self.speed_over_step_m_s, self.play) = (now, control.speed_m_s, steering);
    }

    /// Keeps a command as the newest one.
    #[inline(always)]
    fn send(&mut self, command: [T; 2]) {
        self.sent.copy_within(0..SENT - 1, 1);
        self.sent[0] = command;
    }

    /// Mean of a channel from `from_s` (s after the begin of the present step, negative before) on for `over_s`: commands are held over their steps.
    fn mean_between(&self, channel: usize, now: T, from_s: f64, over_s: f64, dt_s: f64) -> T {
        let (mut sum, mut left) = (T::lit(0.0), over_s);
        let mut take = |value: T, begin_s: f64, end_s: f64| {
            let overlap = ((from_s + over_s).min(end_s) - from_s.max(begin_s)).max(0.0).min(left);
            if overlap > 0.0 {
                sum = sum + value * T::lit(overlap / over_s);
                left -= overlap;
            }
        };
        take(now, 0.0, f64::INFINITY);
        for (steps, pair) in self.sent.iter().enumerate() {
            let end_s = -(steps as f64) * dt_s;
            if end_s <= from_s {
                break;
            }
            take(pair[channel], if steps + 1 == SENT { f64::NEG_INFINITY } else { end_s - dt_s }, end_s);
        }
        sum
    }

    /// Passes a held input through the lag of a channel; mean output over the piece.
    fn lag(&mut self, channel: usize, input: T, lag_s: f64, piece_s: f64) -> T {
        if lag_s <= 0.0 {
            self.lagged[channel] = input;
            return input;
        }
        let kept = (-piece_s / lag_s).exp();
        let behind = self.lagged[channel] - input;
        self.lagged[channel] = input + behind * T::lit(kept);
        input + behind * T::lit((1.0 - kept) * lag_s / piece_s)
    }
}
