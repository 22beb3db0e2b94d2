//! Drives that begin at a limit of the drive line: what the commands asked for before shows in nothing there.

/// Share of all samples below the largest ones, and shares of these at which rims are held by a limit and have come away from it.
const LARGE: f64 = 0.98;
const AT_LIMIT: f64 = 0.95;
const AWAY: f64 = 0.9;

/// Which drives begin at a limit of the speed, the turning or a rim and come away from it, by the speeds of their left and right rims at every sample, m/s; none where fewer
/// than a fourth would be left. How far beyond the limit the command was before shows in nothing, and a lag would be blamed for the time that it takes to come back to it.
pub fn limited_starts(rims_m_s: &[impl AsRef<[[f64; 2]]>]) -> Vec<bool> {
    let sizes = |[left, right]: [f64; 2]| [(0.5 * (left + right)).abs(), (0.5 * (right - left)).abs(), left.abs().max(right.abs())];
    let largest: [f64; 3] = core::array::from_fn(|i| {
        let mut all: Vec<f64> = rims_m_s.iter().flat_map(AsRef::as_ref).map(|rims| sizes(*rims)[i]).collect();
        all.sort_by(f64::total_cmp);
        all.get((LARGE * all.len().saturating_sub(1) as f64) as usize).copied().unwrap_or(0.0)
    });
    let comes_away = |drive: &[[f64; 2]]| {
        let least = |i: usize| drive.iter().map(|rims| sizes(*rims)[i]).fold(f64::INFINITY, f64::min);
        drive.first().is_some_and(|first| (0..3).any(|i| sizes(*first)[i] > AT_LIMIT * largest[i] && least(i) < AWAY * largest[i]))
    };
    let limited: Vec<bool> = rims_m_s.iter().map(|drive| comes_away(drive.as_ref())).collect();
    if 4 * limited.iter().filter(|out| !**out).count() < limited.len() { vec![false; limited.len()] } else { limited }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: drives that come away from a limit are told from those that stay at it and those that reach it later. Method: a limit of 1 m/s by hand, drives that reach it.
    #[test]
    fn analytic_drives_that_come_away_from_a_limit() {
        let straight = |speeds: &[f64]| speeds.iter().map(|v| [*v, *v]).collect::<Vec<_>>();
        let [away, held, reached] = [straight(&[1.0, 0.8, 0.2]), straight(&[1.0, 1.0, 1.0]), straight(&[0.0, 0.5, 1.0])];
        let drives = [held.clone(), away.clone(), reached.clone(), reached];
        assert_eq!(limited_starts(&drives), [false, true, false, false]);
        // All of them: better late than nothing.
        assert_eq!(limited_starts(&[held, away.clone(), away.clone(), away.clone(), away]), [false, true, true, true, true].map(|_| false));
        let none: [Vec<[f64; 2]>; 0] = [];
        assert!(limited_starts(&[Vec::new()]) == [false] && limited_starts(&none).is_empty());
    }
}
