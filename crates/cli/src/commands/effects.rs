//! `nesam effects`: physical effects on a session of a running server, and into a bundle.

mod write;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use nesam_client::{Client, ClientError, Tls, v1};
use nesam_model::ModelBundle;
use nesam_physics::effects::Effect;

use crate::failure::{Failure, OrFail, chain};
use crate::output::say;

/// Options of `nesam effects`.
#[derive(Args, Debug)]
pub struct EffectsArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    #[command(flatten)]
    OnSession(OnSession),
    /// Write a new version of a bundle that has further effects, named or written as formulas
    Write(write::WriteArgs),
}

#[derive(Subcommand, Debug)]
enum OnSession {
    /// Put effects on a session, in place of those that were applied before; the soil begins again from its prior
    Apply(ApplyArgs),
    /// Take the applied effects away; the soil begins again from its prior
    Revert(ServerArgs),
    /// Say which effects act in the sessions that a server has, and which alarms are active; of servers that share sessions each lists its own
    List(ServerArgs),
}

#[derive(Args, Debug)]
struct ServerArgs {
    /// Address of the server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:50051")]
    server: String,
    /// Session; `list` alone goes without: it lists all then
    #[arg(long, value_name = "ID", default_value = "", hide_default_value = true)]
    session: String,
    /// CA of the server, PEM; with it the connection is TLS
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// Certificate of this client, PEM: an operator's may apply and revert
    #[arg(long, value_name = "FILE", requires_all = ["ca", "key"])]
    certificate: Option<PathBuf>,
    /// Key of that certificate, PEM
    #[arg(long, value_name = "FILE", requires = "certificate")]
    key: Option<PathBuf>,
}

#[derive(Args, Debug)]
struct ApplyArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Every effect that a bundle adds to its card, as `nesam diagnose --out` writes it
    #[arg(long, value_name = "DIR", conflicts_with = "effects", required_unless_present = "effects")]
    bundle: Option<PathBuf>,
    /// An effect with all of its parameters, a standard deviation after `~` where there is one: steering_offset:second=0.08~0.01
    #[arg(long = "effect", value_name = "ID:NAME=VALUE,…")]
    effects: Vec<String>,
}

/// Runs the command.
pub fn run(args: &EffectsArgs) -> Result<(), Failure> {
    let what = match &args.what {
        What::Write(args) => return write::run(args),
        What::OnSession(what) => what,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().or_failed()?;
    runtime.block_on(async {
        match what {
            OnSession::Apply(args) => {
                let (source, effects) = wanted(args)?;
                let session = connect(&args.server).await?.apply_effects(named(&args.server)?, &source, effects).await;
                show(&session.map_err(refused)?);
            }
            OnSession::Revert(args) => {
                let session = connect(args).await?.revert_effects(named(args)?).await;
                show(&session.map_err(refused)?);
            }
            OnSession::List(args) => {
                let sessions = connect(args).await?.list_sessions().await.map_err(refused)?;
                let asked: Vec<_> = sessions.iter().filter(|s| args.session.is_empty() || s.session_id == args.session).collect();
                if asked.is_empty() && !args.session.is_empty() {
                    return Err(Failure::input(format!("session `{}` is not open", args.session)));
                }
                asked.into_iter().for_each(show);
            }
        }
        Ok(())
    })
}

fn named(args: &ServerArgs) -> Result<&str, Failure> {
    if args.session.is_empty() { Err(Failure::input("which session? give --session ID")) } else { Ok(&args.session) }
}

async fn connect(args: &ServerArgs) -> Result<Client, Failure> {
    let Some(ca) = &args.ca else { return Client::connect(&args.server).await.map_err(refused) };
    let tls = Tls::from_files(ca, args.certificate.as_deref().zip(args.key.as_deref())).map_err(refused)?;
    Client::connect_tls(&args.server, &tls).await.map_err(refused)
}

fn refused(error: ClientError) -> Failure {
    if error.code().is_some() { Failure::Input(error.to_string()) } else { Failure::Failed(chain(&error)) }
}

/// Where the effects come from, and the effects.
fn wanted(args: &ApplyArgs) -> Result<(String, Vec<v1::Effect>), Failure> {
    let Some(dir) = &args.bundle else {
        let effects = args.effects.iter().map(|text| parsed(text)).collect::<Result<_, _>>()?;
        return Ok(("command line".into(), effects));
    };
    let bundle = ModelBundle::load(dir).or_input()?;
    if bundle.effects.is_empty() {
        return Err(Failure::input(format!("bundle {} adds no effect to its card", dir.display())));
    }
    if let Some(written) = bundle.effects.iter().find(|e| matches!(e.effect, Effect::Written(_))) {
        let why = "is written as formulas, which do not travel to a running session; serve that bundle instead";
        return Err(Failure::input(format!("`{}` of bundle {} {why}", written.effect.id(), dir.display())));
    }
    let effects = bundle.effects.iter().map(|e| {
        let parameters = e.effect.parameters();
        let parameters = parameters.iter().map(|p| v1::EffectParameter { name: p.name.into(), value: p.value, sd: 0.0 });
        v1::Effect { id: e.effect.id().into(), parameters: parameters.collect() }
    });
    Ok((format!("bundle {} {}", bundle.name, &bundle.hash[..12.min(bundle.hash.len())]), effects.collect()))
}

/// `steering_offset:second=0.08~0.01` as a message.
fn parsed(text: &str) -> Result<v1::Effect, Failure> {
    let wrong = |what: &str| Failure::input(format!("--effect {text}: {what}; write ID:NAME=VALUE,NAME=VALUE~SD"));
    let (id, rest) = text.split_once(':').unwrap_or((text, ""));
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| wrong(&format!("`{text}` is no number")));
    let parameter = |part: &str| {
        let (name, value) = part.split_once('=').ok_or_else(|| wrong(&format!("`{part}` has no `=`")))?;
        let (value, sd) = value.split_once('~').map_or((value, None), |(value, sd)| (value, Some(sd)));
        Ok(v1::EffectParameter { name: name.trim().into(), value: number(value)?, sd: sd.map(number).transpose()?.unwrap_or(0.0) })
    };
    let parameters = rest.split(',').filter(|part| !part.trim().is_empty()).map(parameter).collect::<Result<_, Failure>>()?;
    Ok(v1::Effect { id: id.trim().into(), parameters })
}

fn show(session: &v1::Session) {
    let from = if session.effects_source.is_empty() { String::new() } else { format!(", from {}", session.effects_source) };
    match session.effects.is_empty() {
        true => say!("{}: no effects beyond those of the bundle", session.session_id),
        false => say!("{}: {} effects{from}", session.session_id, session.effects.len()),
    }
    for effect in &session.effects {
        let parameter = |p: &v1::EffectParameter| {
            if p.sd > 0.0 { format!("{} = {} ± {}", p.name, p.value, p.sd) } else { format!("{} = {}", p.name, p.value) }
        };
        say!("  {}: {}", effect.id, effect.parameters.iter().map(parameter).collect::<Vec<_>>().join(", "));
    }
    if let Some(alarm) = &session.alarm {
        say!("  alarm since {} ns: {}\n  {}", alarm.onset_stamp_ns, alarm.description, alarm.diagnose);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_effects_on_the_command_line_are_read() {
        let effect = parsed("wheel_drag:wheel=1,torque_n_m=900~50").unwrap();
        let parameter = |name: &str, value: f64, sd: f64| v1::EffectParameter { name: name.into(), value, sd };
        assert_eq!(
            effect,
            v1::Effect { id: "wheel_drag".into(), parameters: vec![parameter("wheel", 1.0, 0.0), parameter("torque_n_m", 900.0, 50.0)] }
        );
        for wrong in ["steering_offset:second", "steering_offset:second=much", "steering_offset:second=0.1~x"] {
            assert!(parsed(wrong).is_err(), "{wrong}");
        }
    }
}
