//! Sequences of commands that somebody wrote down.

use nesam_physics::Control;

/// First line of such a text.
const HEADER: &str = "speed_m_s,second";

/// Commands of a table of comma-separated values: the header `speed_m_s,second`, then a line for each step with a speed in m/s and the second command, whose unit
/// is that of the vehicle card (rad of steering, 1/m of curvature or rad/s of yaw rate). Empty lines and a byte order mark are passed over.
///
/// # Errors
/// The line that is not two finite numbers, another header, or no line below it.
pub fn commands_from_csv(text: &str) -> Result<Vec<Control<f64>>, String> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let header = lines.next().map_or("", |(_, line)| line.trim());
    if header.replace(' ', "") != HEADER {
        return Err(format!("line 1 is `{header}`, expected `{HEADER}`"));
    }
    let commands: Vec<_> = lines
        .map(|(i, line)| {
            let cells: Vec<_> = line.split(',').map(|cell| cell.trim().parse().ok().filter(|value: &f64| value.is_finite())).collect();
            match cells[..] {
                [Some(speed_m_s), Some(second)] => Ok(Control { speed_m_s, second }),
                _ => Err(format!("line {}: `{line}` is not two finite numbers", i + 1)),
            }
        })
        .collect::<Result<_, _>>()?;
    if commands.is_empty() { Err("no commands below the header".into()) } else { Ok(commands) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_commands_are_read_and_the_line_at_fault_is_named() {
        let expected = [Control { speed_m_s: 2.0, second: 0.1 }, Control { speed_m_s: -1.0, second: 0.0 }];
        for text in ["speed_m_s,second\n2,0.1\n-1,0\n", "\u{feff}speed_m_s, second\r\n\r\n 2 , 0.1\r\n-1,0"] {
            assert_eq!(commands_from_csv(text).as_deref(), Ok(&expected[..]));
        }
        for (text, reason) in [
            ("", "line 1 is ``"),
            ("second,speed_m_s\n1,2", "expected `speed_m_s,second`"),
            ("speed_m_s,second\n", "no commands"),
            ("speed_m_s,second\n2,0.1\n\n2,NaN", "line 4: `2,NaN`"),
            ("speed_m_s,second\n2", "line 2"),
            ("speed_m_s,second\n2,1,0", "line 2"),
        ] {
            let refused = commands_from_csv(text).unwrap_err();
            assert!(refused.contains(reason), "{text:?}: {refused}");
        }
    }
}
