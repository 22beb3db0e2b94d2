//! The six-by-six solve of the semi-implicit step.

use crate::scalar::Real;

/// Solves the symmetric positive definite system A x = b by Cholesky; the lower triangle of A is read.
#[inline(always)]
pub fn solve_spd<T: Real, const N: usize>(mut a: [[T; N]; N], mut b: [T; N]) -> [T; N] {
    for j in 0..N {
        for k in 0..j {
            a[j][j] = a[j][j] - a[j][k] * a[j][k];
        }
        a[j][j] = a[j][j].sqrt();
        let inverse = T::lit(1.0) / a[j][j];
        for i in j + 1..N {
            for k in 0..j {
                a[i][j] = a[i][j] - a[i][k] * a[j][k];
            }
            a[i][j] = a[i][j] * inverse;
        }
    }
    for i in 0..N {
        for k in 0..i {
            b[i] = b[i] - a[i][k] * b[k];
        }
        b[i] = b[i] / a[i][i];
    }
    for i in (0..N).rev() {
        for k in i + 1..N {
            b[i] = b[i] - a[k][i] * b[k];
        }
        b[i] = b[i] / a[i][i];
    }
    b
}
