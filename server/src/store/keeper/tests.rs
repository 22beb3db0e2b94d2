//! Goal: what is called settled is on stable storage. Method: the notes of engine, store and other servers in the orders in which they may come.

use super::*;

const BUDGET: Duration = Duration::from_secs(10);

fn keeper() -> (Keeper, Key) {
    let keeper = Keeper::new(Duration::from_secs(1));
    opened(&keeper);
    (keeper, Key::Session("s".into()))
}

fn opened(keeper: &Keeper) {
    keeper.note(&Event::SessionOpened { session: "s".into(), vehicle: "truck".into() });
}

/// A commit of all that waits; `places` = what it wrote.
fn commit(keeper: &Keeper, places: &Places) {
    let due: BTreeMap<Key, u64> = keeper.lock().dirty.iter().map(|(key, dirty)| (key.clone(), dirty.latest)).collect();
    keeper.committed(&due, places, 0, Duration::ZERO);
}

fn written() -> Places {
    Places::from([("s".into(), Some(3))])
}

/// What somebody hears who begins to wait before `then` happens.
async fn settled_while(keeper: &Keeper, key: &Key, then: impl FnOnce()) -> bool {
    let (settled, ()) = tokio::join!(keeper.settled(key, BUDGET), async { then() });
    settled
}

#[tokio::test]
async fn analytic_a_change_is_settled_once_it_is_written() {
    let (keeper, key) = keeper();
    assert!(!keeper.settled(&key, Duration::ZERO).await, "not yet");
    assert!(settled_while(&keeper, &key, || commit(&keeper, &written())).await);
    assert_eq!((keeper.durable("s"), keeper.settled(&key, BUDGET).await, keeper.has_left("s")), (3, true, false));
}

#[tokio::test]
async fn regress_what_left_before_it_was_written_is_not_settled() {
    let (keeper, key) = keeper();
    let leaves = || {
        keeper.forget("s");
        keeper.forgotten("s");
        commit(&keeper, &Places::new());
    };
    assert!(!settled_while(&keeper, &key, leaves).await);
    assert!(!keeper.settled(&key, BUDGET).await, "nor for who asks later");
    assert!(keeper.has_left("s"));

    // It comes back, with changes of its own.
    opened(&keeper);
    assert!(settled_while(&keeper, &key, || commit(&keeper, &written())).await);
    assert!(keeper.settled(&key, BUDGET).await && !keeper.has_left("s"));
}

#[tokio::test]
async fn regress_what_a_commit_left_to_another_server_is_not_settled() {
    let (keeper, key) = keeper();
    assert!(!settled_while(&keeper, &key, || commit(&keeper, &Places::new())).await);
    assert!(!keeper.settled(&key, BUDGET).await && keeper.has_left("s"));
    assert_eq!(keeper.durable("s"), 0);
}

/// Goal: the age of the oldest change that is not durable is what it is, also where a session changes again while it is committed. Method: a commit that is said to
/// have begun long before.
#[tokio::test]
async fn regress_the_age_of_what_waits_is_known() {
    let (begun, long) = (std::time::Instant::now(), Duration::from_secs(1000));
    let (keeper, _) = keeper();
    let due: BTreeMap<Key, u64> = keeper.lock().dirty.iter().map(|(key, dirty)| (key.clone(), dirty.latest)).collect();
    assert!(keeper.oldest().unwrap() <= begun.elapsed());
    keeper.note(&Event::MeasurementAccepted { session: "s".into(), buffer_ended: false });
    keeper.committed(&due, &written(), 0, Duration::ZERO);
    assert!(keeper.oldest().is_some_and(|oldest| oldest <= begun.elapsed()), "the measurement waits");
    keeper.committed(&due, &written(), 0, long);
    assert!(keeper.oldest().is_some_and(|oldest| oldest >= long), "it may have come as soon as the commit began");
    assert!(keeper.counts().oldest_s >= long.as_secs_f64());
    commit(&keeper, &written());
    assert_eq!((keeper.oldest(), keeper.counts().oldest_s), (None, 0.0));
}
