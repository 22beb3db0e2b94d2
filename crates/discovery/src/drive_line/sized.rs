//! Effects of a drive line with their sizes, and whether others leave more.

/// Share of the error of the wheel speeds that an effect takes away, at least (chosen).
const SHARE_MIN: f64 = 0.02;
/// Standard errors over drives by which the error falls with an effect, at least (chosen).
pub(super) const T_MIN: f64 = 3.5;
/// Standard errors more that few drives need, times one less than their number (chosen: about what Student's t needs).
const FEW: f64 = 8.0;
/// Drives in which an effect must show.
const TELLING_MIN: usize = 4;
/// Share of the error of a drive by which it must change to say anything.
const SAME: f64 = 0.01;

/// Sizes of effects that were fitted together, with the squared error of each drive, (m/s)².
#[derive(Clone, Debug, Default)]
pub(super) struct Sized {
    pub terms: Vec<usize>,
    pub values: Vec<f64>,
    pub by_drive: Vec<f64>,
}

impl Sized {
    pub(super) fn error(&self) -> f64 {
        self.by_drive.iter().sum()
    }

    /// Whether the error falls enough from another's to this.
    pub(super) fn falls_from(&self, other: &Self) -> bool {
        other.error() - self.error() >= SHARE_MIN * other.error()
    }

    /// By how many standard errors over drives another leaves more, in roots of squares: by the mean, which few drives of like size show, or by signed ranks (Wilcoxon
    /// 1945), which many of unlike size do. Drives in which both leave the same, as they never reach a limit, say nothing; zero where fewer than four say anything.
    pub(super) fn less_than(&self, other: &Self) -> f64 {
        let roots = other.by_drive.iter().zip(&self.by_drive).map(|(other, own)| (other.sqrt(), own.sqrt()));
        let more: Vec<f64> = roots.filter(|(a, b)| (a - b).abs() > SAME * a.max(*b)).map(|(other, own)| other - own).collect();
        if more.len() < TELLING_MIN {
            return 0.0;
        }
        let n = more.len() as f64;
        let mean = more.iter().sum::<f64>() / n;
        let square = more.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
        // Few drives know their scatter badly.
        let by_mean = mean / (square / n).sqrt().max(1e-300) * T_MIN / (T_MIN + FEW / (n - 1.0));
        by_mean.max(signed_ranks(more))
    }
}

/// Sum of the ranks by size of what is positive, in standard deviations from what chance makes of it.
fn signed_ranks(mut values: Vec<f64>) -> f64 {
    values.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
    let n = values.len() as f64;
    let positive: f64 = values.iter().zip(1..).filter(|(v, _)| **v > 0.0).map(|(_, rank)| f64::from(rank)).sum();
    (positive - 0.25 * n * (n + 1.0)) / (n * (n + 1.0) * (2.0 * n + 1.0) / 24.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: an effect that shows in some drives is sure, one that makes as many worse is not, and few drives say little. Method: errors of forty drives by hand, of which a
    /// limit shows in fourteen, in sizes that are most unlike.
    #[test]
    pub(super) fn analytic_what_shows_in_some_drives_is_sure() {
        let sized = |squares: &[f64]| Sized { by_drive: squares.to_vec(), ..Sized::default() };
        let without: Vec<f64> = (0..40).map(|d| if d < 14 { 1.0 + 100f64.powi(d) } else { 1.0 }).collect();
        let (with, without) = (sized(&[1.0; 40]), sized(&without));
        assert_eq!(with.less_than(&sized(&[1.0; 40])), 0.0);
        // The largest outweighs the mean; all fourteen are of one sign: 14 · 15 / 4 / √(14 · 15 · 29 / 24).
        assert!((with.less_than(&without) - 52.5 / 253.75f64.sqrt()).abs() < 1e-9, "{}", with.less_than(&without));
        let either: Vec<f64> = (0..40).map(|d| if d % 2 == 0 { 1.5 } else { 0.6 }).collect();
        assert!(with.less_than(&sized(&either)).abs() < 1.0);
        assert_eq!(sized(&[1.0; 3]).less_than(&sized(&[2.0; 3])), 0.0);
    }
}
