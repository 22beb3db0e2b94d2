//! Goal: candidates that the service draws are those that it says, the best of a ranking are the best, and both save the bytes that they are for. Method: the
//! same question again with everything sent and everything returned, and the cost computed anew from those states.

use nesam_client::{Candidates, v1};
use nesam_trajectories::Trajectory;
use prost::Message as _;
use tonic::Code;

use crate::stage::*;

const NEWEST: usize = 40;

/// Noise around the recorded commands.
fn drawn(drive: &Trajectory, samples: usize, horizon: usize) -> Candidates {
    let nominal = candidates("truck", drive, NEWEST, 1, horizon).controls;
    let drawing = v1::CandidateDrawing { speed_sd_m_s: 0.8, second_sd: 0.2, correlation: 0.8, seed: 5, ..Default::default() };
    Candidates::drawn("truck", samples, &nominal, drawing)
}

/// A straight path through two points, and what it costs to leave it.
fn cost(best: u32) -> v1::PathCost {
    v1::PathCost {
        speed_m_s: 2.5,
        path_weight: 2.0,
        speed_weight: 0.5,
        tilt_weight: 4.0,
        speed_change_weight: 0.3,
        second_change_weight: 0.7,
        best,
        temperature: 0.2,
        ..Default::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_the_best_of_drawn_candidates_are_the_best() {
    let (server, mut client, recorded) = driven("truck", NEWEST).await;
    let (samples, horizon) = (24, 16);

    // Everything, and the same candidates sent back.
    let all = client.predict(drawn(&recorded.drive, samples, horizon)).await.unwrap();
    assert_eq!(all.drawn_controls.len(), samples * horizon * 2);
    let sent = client.predict(Candidates::new("truck", samples, horizon, all.drawn_controls.clone())).await.unwrap();
    assert_eq!(bits(&sent.states), bits(&all.states));
    assert!(sent.drawn_controls.is_empty() && sent.costs.is_empty());

    let [x, y] = [all.start[0], all.start[1]];
    let direction = [all.start[5].cos(), all.start[5].sin()];
    let path = [-20.0, 60.0].map(|s| [x + s * direction[0], y + s * direction[1] + 0.5]);
    let ranked = client
        .predict(
            drawn(&recorded.drive, samples, horizon).ranked(&path.as_flattened().iter().map(|v| *v as f32).collect::<Vec<_>>(), cost(4)),
        )
        .await
        .unwrap();
    assert_eq!((ranked.samples, ranked.costs.len(), ranked.best.len(), ranked.validity.len()), (samples, samples, 4, 4));

    // The cost again, by the words of the interface.
    let expected: Vec<f64> = (0..samples)
        .map(|n| {
            let of_states = (0..horizon).map(|k| {
                let state: Vec<f64> = all.state(n, k).iter().map(|v| f64::from(*v)).collect();
                let off = [state[0] - path[0][0], state[1] - path[0][1]];
                let distance = off[0] * direction[1] - off[1] * direction[0];
                let velocity =
                    [state[6] * state[5].cos() - state[7] * state[5].sin(), state[6] * state[5].sin() + state[7] * state[5].cos()];
                let along = velocity[0] * direction[0] + velocity[1] * direction[1];
                2.0 * distance.powi(2) + 0.5 * (along - 2.5).powi(2) + 4.0 * (state[3].powi(2) + state[4].powi(2))
            });
            let command = |k: usize, i: usize| f64::from(all.drawn_controls[(n * horizon + k) * 2 + i]);
            let of_commands =
                (1..horizon).map(|k| 0.3 * (command(k, 0) - command(k - 1, 0)).powi(2) + 0.7 * (command(k, 1) - command(k - 1, 1)).powi(2));
            (of_states.sum::<f64>() + of_commands.sum::<f64>()) / horizon as f64
        })
        .collect();
    for (found, expected) in ranked.costs.iter().zip(&expected) {
        assert!((f64::from(*found) - expected).abs() < 1e-3 * expected.max(0.1), "{found} {expected}");
    }
    let mut order: Vec<usize> = (0..samples).collect();
    order.sort_by(|a, b| ranked.costs[*a].total_cmp(&ranked.costs[*b]));
    assert_eq!(ranked.best.iter().map(|n| *n as usize).collect::<Vec<_>>(), order[..4]);
    for (row, n) in order[..4].iter().enumerate() {
        assert_eq!(bits(ranked.state(row, horizon - 1)), bits(all.state(*n, horizon - 1)));
        let width = horizon * 2;
        assert_eq!(ranked.drawn_controls[row * width..(row + 1) * width], all.drawn_controls[n * width..(n + 1) * width]);
    }
    let weights: Vec<f64> = expected.iter().map(|cost| (-cost / 0.2).exp()).collect();
    let first =
        (0..samples).map(|n| weights[n] * f64::from(all.drawn_controls[n * horizon * 2 + 1])).sum::<f64>() / weights.iter().sum::<f64>();
    assert!((f64::from(ranked.mean_controls[1]) - first).abs() < 1e-3, "{} {first}", ranked.mean_controls[1]);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_drawing_and_ranking_save_bytes() {
    let (server, _client, recorded) = driven("truck", NEWEST).await;
    let (samples, horizon) = (1024, 32);
    let channel = tonic::transport::Endpoint::new(format!("http://{}", server.grpc_addr)).unwrap().connect().await.unwrap();
    let mut raw = v1::prediction_client::PredictionClient::new(channel);
    let path: Vec<f32> = (0..40).flat_map(|i| [i as f32, 0.0]).collect();
    let short = drawn(&recorded.drive, samples, horizon).ranked(&path, cost(4)).to_message();
    let answer = raw.predict(short.clone()).await.unwrap().into_inner();
    let long = Candidates::new("truck", samples, horizon, vec![0.5; samples * horizon * 2]).to_message();
    let whole = raw.predict(long.clone()).await.unwrap().into_inner();
    let [asked, replied] =
        [(&short, &answer), (&long, &whole)].map(|(ask, reply)| (ask.encoded_len(), reply.encoded_len())).map(|(a, r)| [a, r]);
    println!("1024 x 32: {asked:?} bytes asked and answered, {replied:?} with everything");
    assert!(asked[0] < 1_000 && asked[1] < 16_000, "{asked:?}");
    assert!(replied[0] > 200_000 && replied[1] > 1_500_000, "{replied:?}");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_contradictory_drawings_and_costs_are_refused_with_the_field() {
    let (server, mut client, recorded) = driven("truck", NEWEST).await;
    let sound = drawn(&recorded.drive, 4, 8);
    let line = [0.0, 0.0, 9.0, 0.0];
    let change = |f: &dyn Fn(&mut v1::CandidateDrawing)| {
        let mut wrong = sound.clone();
        f(wrong.drawing.as_mut().unwrap());
        wrong
    };
    let extras = Some(v1::PredictExtras { risk: true, ..Default::default() });
    let wrong = [
        ("controls", Candidates { controls: vec![0.0; 4 * 8 * 2], ..sound.clone() }),
        ("drawing.nominal", change(&|drawing| drawing.nominal = vec![0; 8].into())),
        (
            "drawing.nominal[0, 0]",
            change(&|drawing| {
                drawing.nominal = [1.0_f32, f32::NAN].repeat(8).iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into()
            }),
        ),
        ("drawing.correlation", change(&|drawing| drawing.correlation = 1.0)),
        ("cost", Candidates { extras, ..sound.clone().ranked(&line, cost(1)) }),
        ("cost.path", sound.clone().ranked(&line[..2], cost(1))),
        ("cost.best", sound.clone().ranked(&line, cost(5))),
        ("cost.tilt_weight", sound.clone().ranked(&line, v1::PathCost { tilt_weight: -1.0, ..cost(1) })),
    ];
    for (field, candidates) in wrong {
        assert_refused(field, client.predict(candidates).await, Code::InvalidArgument, field);
    }
    let none = client.predict(sound.ranked(&line, cost(0))).await.unwrap();
    assert_eq!((none.costs.len(), none.states.len(), none.validity.len()), (4, 0, 0));
    server.shutdown().await;
}
