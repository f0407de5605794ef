"""The store of finished replies: what it gives back, what it forgets first, and that threads do not upset its books."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from server.finished_replies import MAX_REPLIES, MAX_TARGETS, Body, FinishedReplies, FinishedReply


def reply(name: str, size: int = 10) -> FinishedReply:
    return FinishedReply(f'"{name}"', "public", Body(name.encode().ljust(size, b"."), "text/plain", {"Gi-Name": name}))


def target(name: str) -> tuple[str, bytes]:
    return "/v1/thing", name.encode()


def test_a_reply_is_found_by_etag_and_by_target() -> None:
    replies = FinishedReplies()
    kept = reply("a")
    replies.keep(target("x=1"), kept)
    assert replies.get('"a"') is kept
    assert replies.at(target("x=1")) is kept
    assert replies.at(target("x=2")) is None
    assert replies.at(("/v1/other", b"x=1")) is None
    assert replies.get('"b"') is None
    replies.keep(target("x=2"), kept)  # another spelling
    assert replies.at(target("x=1")) is replies.at(target("x=2")) is kept
    replies.clear()
    assert replies.at(target("x=1")) is None
    assert replies.get('"a"') is None


def test_the_least_recently_used_reply_makes_room() -> None:
    replies = FinishedReplies(max_bytes=30)
    for name in "abc":
        replies.keep(target(name), reply(name))
    replies.at(target("a"))
    replies.keep(target("d"), reply("d"))
    assert [name for name in "abcd" if replies.at(target(name))] == ["a", "c", "d"]
    replies.keep(target("wide"), reply("wide", 25))
    assert [name for name in ("a", "c", "d", "wide") if replies.at(target(name))] == ["wide"]


def test_what_is_larger_than_the_store_is_not_kept_and_displaces_nothing() -> None:
    replies = FinishedReplies(max_bytes=30)
    replies.keep(target("a"), reply("a"))
    replies.keep(target("big"), reply("big", 31))
    assert replies.at(target("big")) is None
    assert replies.at(target("a")) is not None


def test_keeping_a_reply_twice_counts_it_once() -> None:
    replies = FinishedReplies(max_bytes=30)
    for _ in range(5):
        replies.keep(target("a"), reply("a"))
    for name in "bc":
        replies.keep(target(name), reply(name))
    assert all(replies.at(target(name)) for name in "abc")


def test_replies_are_bounded_in_number_however_small_they_are() -> None:
    replies = FinishedReplies()
    for number in range(MAX_REPLIES + 2):
        replies.keep(target("same"), reply(str(number)))
    assert [replies.get(f'"{number}"') is None for number in range(4)] == [True, True, False, False]
    assert replies.nbytes == 10 * MAX_REPLIES


def test_targets_are_bounded_in_number_and_length() -> None:
    replies = FinishedReplies()
    replies.keep(target("first"), reply("a"))
    for number in range(MAX_TARGETS):
        replies.keep(target(str(number)), reply("a"))
    assert replies.at(target("first")) is None
    assert replies.at(target("0")) is not None
    replies.keep(target("long" * 1000), reply("a"))
    assert replies.at(target("long" * 1000)) is None
    assert replies.get('"a"') is not None


@pytest.mark.parametrize(
    ("header", "status"), [("", 200), ('"a"', 304), ('W/"a"', 304), ('"b", "a"', 304), ("*", 304), ('"b"', 200), ("a", 200)]
)
def test_a_client_that_has_it_gets_304(header: str, status: int) -> None:
    answer = reply("a").answer({"if-none-match": header})
    assert answer.status_code == status
    assert answer.headers["etag"] == '"a"'
    assert answer.headers["cache-control"] == "public"
    assert bytes(answer.body) == (b"" if status == 304 else b"a.........")
    assert ("gi-name" in answer.headers) == (status == 200)


def test_threads_leave_the_store_within_its_bound() -> None:
    replies = FinishedReplies(max_bytes=200)

    def use(worker: int) -> None:
        for number in range(500):
            name = str((worker * 7 + number) % 40)
            found = replies.at(target(name))
            assert found is None or found.etag == f'"{name}"'
            replies.keep(target(name), reply(name))

    with ThreadPoolExecutor(8) as pool:
        for done in [pool.submit(use, worker) for worker in range(8)]:
            done.result()
    kept = [name for name in map(str, range(40)) if replies.get(f'"{name}"')]
    assert len(kept) == 20  # 200 bytes of 10 each: full, and not one more
