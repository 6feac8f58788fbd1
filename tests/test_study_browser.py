"""A person's way through the study in a real browser, and what is stored of it."""

import numpy as np
import pytest
from playwright.sync_api import Error, sync_playwright
from study_server import SECRET, browser_program, free_port, serving

from experiments.models import open_model
from experiments.study.recording import actions_of
from experiments.study.store import Store
from experiments.study.study import Kitchen
from experiments.study.tables import END, FINISHED

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
KEYS = ("ArrowLeft", "ArrowUp", " ", "ArrowRight", "ArrowDown", " ")


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=browser_program(), args=ARGUMENTS)
        yield found
        found.close()


@pytest.fixture(scope="module")
def study(browser, tmp_path_factory):
    """A server that ticks fast, with both kinds of agents once; gives its folder and address."""
    folder = tmp_path_factory.mktemp("study")
    with serving(folder, free_port(), "--hertz", "30", "--players", "4") as (_, address):
        yield folder, address


def drawn(page):
    """How many colours the middle of the board has: nothing is drawn yet where it is one."""
    return page.evaluate(
        """() => {
            const canvas = document.querySelector(".board");
            const { width, height } = canvas;
            const data = canvas.getContext("2d").getImageData(0, 0, width, height).data;
            const seen = new Set();
            for (let i = 0; i < data.length; i += 4 * 97) seen.add(`${data.slice(i, i + 3)}`);
            return seen.size;
        }"""
    )


def until(page, true, seconds=20):
    """Waits until an expression holds on the page (whose policy forbids Playwright's own way)."""
    for _ in range(20 * seconds):
        try:
            if page.evaluate(f"() => {true}"):
                return
        except Error:
            pass  # another page is coming
        page.wait_for_timeout(50)
    raise AssertionError(f"{true} did not become true on {page.url}: {page.inner_text('main')}")


def reach(page, step):
    """Waits until the page shows a later step."""
    until(page, f"Number(document.querySelector('.step')?.textContent) > {step}")


def play_round(page, sentence):
    page.fill("textarea", sentence)
    page.click("button.button")
    page.wait_for_selector("#game")
    reach(page, 3)
    assert drawn(page) > 10
    index = 0
    while page.url.endswith("/study") and page.query_selector("#game"):
        key = KEYS[index % len(KEYS)]
        index += 1
        try:
            page.keyboard.down(key)
            page.wait_for_timeout(60)
            page.keyboard.up(key)
            if page.inner_text(".step") == "400":
                break
        except Error:  # the page goes on by itself
            break
    page.wait_for_selector("input[name=rating]", state="attached", timeout=20_000)


def test_from_consent_to_thanks(browser, study):
    folder, address = study
    page = browser.new_page()
    said = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("console", lambda message: said.append(message.text))
    page.goto(address)
    page.click("text=Take part")
    page.check("input[name=agree]")
    page.click("button")
    assert "The game" in page.inner_text("h1")
    page.click("text=Watch a demonstration")
    reach(page, 2)
    assert drawn(page) > 10
    page.click("text=I have seen enough")
    tasks, scripts = [], []
    page.route("**/static/replay.js", lambda route: scripts.append(route))
    for number, rating in ((1, 5), (2, 2)):
        assert f"Round {number} of 2" in page.inner_text("h1")
        tasks.append(page.inner_text(".task"))
        for word in ("haland", "oracle", "Oracle", "universal"):
            assert word not in page.content(), "the agent's kind is hidden"
        play_round(page, f"Round {number}: {tasks[-1]}")
        page.click(f".rating label:nth-of-type({rating})")
        page.fill("textarea", f"comment {number}")
        page.click("text=Go on")
    until(page, "document.querySelector('h1').textContent === 'Thank you'")
    code = page.inner_text(".code")
    assert page.is_disabled("text=Round 2"), "a click before the script has come would be lost"
    scripts[0].continue_()
    page.route("**/study/replay/0", lambda route: route.abort())
    page.click("text=Round 1")
    until(page, "document.querySelector('.note').textContent.includes('cannot be shown')")
    assert page.is_visible(".note")
    page.click("text=Round 2")
    reach(page, 5)
    assert page.inner_text(".note") == ""
    assert drawn(page) > 10
    # The request that was aborted, and a remark of Chromium's on a page that has the focus already.
    expected = ("favicon", "ERR_FAILED", "Autofocus processing was blocked")
    said = [line for line in said if not any(part in line for part in expected)]
    assert not said, said

    store = Store(f"sqlite:///{folder / 'study.db'}")
    rounds = [one for one in store.rounds() if one.participant.code == code]
    assert [(one.status, one.rating, one.comment) for one in rounds] == [
        (FINISHED, 5, "comment 1"), (FINISHED, 2, "comment 2")
    ]  # fmt: skip
    assert {one.condition for one in rounds} == {"haland", "oracle"}
    assert rounds[0].participant.stage == END
    kitchen = Kitchen("x", open_model("pretrained:overcooked/diverse_orders"), 1)
    for one, task in zip(rounds, tasks, strict=True):
        assert kitchen.tasks.styles[one.style] == task
        assert task in one.sentence
        steps = store.steps(one.id)
        assert len(steps) == one.steps == 400
        style = kitchen.env.style_names.index(one.style)
        again = kitchen.arena.replay(style, one.game_seed, actions_of(steps))
        np.testing.assert_array_equal(again.rewards, steps["reward"])
        assert int(again.states.time[-1]) == 400
        pressed = np.bincount(steps["person"], minlength=6)
        assert (pressed[:4] > 5).all(), "every arrow key arrived"
        assert pressed[5] > 5, "so did the space bar"
        assert one.timing["round_trip_p99"] >= 0
        # The stored policy is the one that played: from the same states it draws the same actions.
        assert len(kitchen.agents.pack(kitchen.agents.unpack(store.round(one.id).policy))) > 1000
    store.close()


def test_free_play_shows_the_task_language_and_records_nothing(browser, study):
    folder, address = study
    store = Store(f"sqlite:///{folder / 'study.db'}")
    before = len(store.rounds())
    page = browser.new_page()
    page.goto(f"{address}/free")
    page.select_option(".of-game:not([hidden]) select", "tomato_4")
    page.fill("textarea", "Tomato soup goes to window four.")
    page.click("button.button")
    reach(page, 3)
    assert "tomato 4" in page.inner_text(".language")
    assert page.query_selector_all(".language meter")
    assert len(store.rounds()) == before
    store.close()


def test_a_lost_connection_is_taken_up_again(browser, study):
    _, address = study
    context = browser.new_context()
    page = context.new_page()
    page.goto(f"{address}/free")
    page.fill("textarea", "Onion soup goes to window one.")
    page.click("button.button")
    reach(page, 3)
    context.set_offline(True)
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    # The browser keeps an open socket when it is set offline; a reload is a new connection.
    context.set_offline(False)
    reached = int(page.inner_text(".step"))
    page.reload()
    reach(page, reached)
    other = context.new_page()
    other.goto(page.url)
    reach(other, 3)
    until(page, "document.querySelector('.note')?.textContent.includes('another window')")
    context.close()


def test_a_touch_pad_plays_too(browser, study):
    _, address = study
    context = browser.new_context(has_touch=True, viewport={"width": 420, "height": 900})
    page = context.new_page()
    page.goto(f"{address}/free")
    page.fill("textarea", "Onion soup goes to window two.")
    page.click("button.button")
    reach(page, 3)
    page.evaluate("document.querySelector('.touch').style.display = 'flex'")
    page.evaluate(
        """() => {
            window.sent = [];
            const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (text) {
                window.sent.push(text);
                send.call(this, text);
            };
        }"""
    )
    page.tap("[data-button=act]")
    page.tap("[data-button=left]")
    sent = [text for text in page.evaluate("window.sent") if "button" in text]
    assert sent == [
        '{"button":"act","down":true}', '{"button":"act","down":false}',
        '{"button":"left","down":true}', '{"button":"left","down":false}',
    ]  # fmt: skip
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= 420, "nothing sticks out on a small screen"
    context.close()


def test_the_researcher_sees_rounds_and_downloads_them(browser, study):
    _, address = study
    page = browser.new_page()
    page.goto(f"{address}/admin")
    page.fill("input[name=secret]", SECRET)
    page.click("text=Open")
    assert "in the 99th percentile" in page.inner_text("main")
    with page.expect_download() as got:
        page.click("text=Rounds, Parquet")
    import pyarrow.parquet as pq

    assert pq.read_table(got.value.path()).num_rows >= 0
