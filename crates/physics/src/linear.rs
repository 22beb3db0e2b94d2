//! The six-by-six solve of the semi-implicit step, and what inertias must be.

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

/// Whether a symmetric matrix is positive definite (Sylvester's criterion).
pub fn is_positive_definite(m: &[[f64; 3]; 3]) -> bool {
    let minor = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    let determinant = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    m[0][0] > 0.0 && minor > 0.0 && determinant > 0.0
}
