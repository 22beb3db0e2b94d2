//! Learning rate and horizon over a run.

/// Linear warm-up over the first 2 % of the steps, then cosine decay to 2 % of `peak`.
pub fn cosine(peak: f64, step: usize, steps: usize) -> f64 {
    let warm = (steps / 50).max(1);
    if step < warm {
        return peak * (step + 1) as f64 / warm as f64;
    }
    let share = (step - warm) as f64 / (steps - warm).max(1) as f64;
    peak * (0.02 + 0.98 * 0.5 * (1.0 + (core::f64::consts::PI * share).cos()))
}

/// Horizon of a training step: a quarter, then half, then all of K, so that early gradients come from short rollouts.
pub fn curriculum(horizon: usize, step: usize, steps: usize) -> usize {
    match step as f64 / steps.max(1) as f64 {
        share if share < 0.15 => (horizon / 4).max(1),
        share if share < 0.35 => (horizon / 2).max(1),
        _ => horizon,
    }
}
