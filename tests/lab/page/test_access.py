"""Access control: Host, Origin and token checks, headers of answers."""

import pytest
from starlette.datastructures import Headers
from websockets.exceptions import InvalidStatus

from flexneedle.lab.page.server import access
from flexneedle.lab.page.server.access import AccessRules
from page_clients import Client, get, port_of, served

HERE, ELSEWHERE = AccessRules.of("127.0.0.1", 8000), AccessRules.of("192.0.2.1", 8000)
ADDRESS = "127.0.0.1:8000"


def refusal(rules, *, socket=True, page=False, query="", **headers):
    """Return the status of a refusal and the part of the request that its reason names, None if it may pass."""
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    refused = rules.refuse(Headers(raw=raw), query, socket=socket, page=page)
    return refused and (refused[0], refused[1].split(" ", 1)[0])


@pytest.mark.parametrize(
    ("passes", "hosts"),
    [
        (True, [ADDRESS, "localhost:8000", "localhost", "[::1]:8000", "LocalHost:9"]),
        (
            False,
            ["evil.example", "127.0.0.1.evil.example", "localhost@evil.example", "10.0.0.1", "", "[::2]"],
        ),
        (
            False,
            [
                "localhost:8000:8000",
                "localhost/",
                "[",
                "127.0.0.1 ",
                "[::1",
                "[abc]",
                "[127.0.0.1]",
                "[::1]x",
            ],
        ),
    ],
)
def test_only_names_of_this_computer_are_hosts(passes, hosts):
    for host in hosts:
        wanted = None if passes else (403, "Host")
        assert refusal(HERE, host=host, origin=f"http://{host}") == wanted, host
    two = Headers(raw=[(b"host", b"127.0.0.1"), (b"host", b"127.0.0.1")])
    assert HERE.refuse(two, "", socket=False) is not None


def test_only_the_page_itself_may_connect():
    """Another site may link to the page, and to nothing else. A web socket needs an origin."""
    foreign = ["http://evil.example", "http://127.0.0.1", "http://127.0.0.1:8001", "http://localhost:8000"]
    for origin in (*foreign, "null", "file://", ""):
        for socket in (True, False):
            assert refusal(HERE, socket=socket, host=ADDRESS, origin=origin) == (403, "Origin")
    assert refusal(HERE, host=ADDRESS) == (403, "Origin")
    assert refusal(HERE, socket=False, host=ADDRESS) is None
    for site in ("cross-site", "same-site", "same-origin", "none"):
        asked = {"socket": False, "host": ADDRESS, "sec_fetch_site": site}
        assert refusal(HERE, page=True, **asked) is None
        assert refusal(HERE, **asked) == ((403, "Sec-Fetch-Site") if site == "cross-site" else None)


def test_another_address_needs_its_token():
    def status(host="192.0.2.1:8000", **given):
        return (refusal(ELSEWHERE, host=host, origin=f"http://{host}", **given) or (200,))[0]

    token = ELSEWHERE.token
    assert status() == 401
    assert status(query=f"token={token}") == status(cookie=f"a=b; {ELSEWHERE.cookie}={token}") == 200
    for wrong in ("", "x", "σ"):
        assert status(query=f"token={wrong}") == status(cookie=f"{ELSEWHERE.cookie}={wrong}") == 401
    assert len(token) >= 32
    assert AccessRules.of("192.0.2.1", 8000).token != token
    assert status("evil.example", query=f"token={token}") == 403  # anybody may resolve a name to this server
    for address in ("192.0.2.7", "[2001:db8::1]:8000"):
        assert status(address, query=f"token={token}") == 200
    for host in ("127.0.0.1", "localhost", "::1", "127.1.2.3"):
        assert AccessRules.of(host, 8000).token == ""


# Over sockets


def test_every_answer_has_the_headers_also_a_refusal(shared_server):
    for path in ("/", "/schema.json", "/scenario.toml", "/nonsense", "/static/nonsense.js"):
        for asked in (
            {},
            {"Host": "evil.example"},
            {"Origin": "http://evil.example"},
            {"Sec_Fetch_Site": "cross-site"},
        ):
            status, _text, headers = get(shared_server, path, **asked)
            passes = not asked or ("Sec_Fetch_Site" in asked and path == "/")
            assert passes == (status != 403)
            policy = headers["content-security-policy"]
            assert "default-src 'none'; script-src 'self';" in policy
            assert "unsafe" not in policy
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
def test_a_foreign_web_socket_is_refused_with_a_reason(shared_server, origin):
    with pytest.raises(InvalidStatus) as refused:
        Client(shared_server, origin=origin)
    assert refused.value.response.status_code == 403
    assert refused.value.response.body.decode().startswith("Origin")


def test_the_token_is_in_the_printed_address_and_then_in_a_cookie(tmp_path, monkeypatch):
    monkeypatch.setattr(access, "is_loopback", lambda _host: False)
    with served(tmp_path) as server:
        assert get(server, "/")[0] == 401
        with pytest.raises(InvalidStatus):
            Client(server)
        status, _text, headers = get(server, "/" + server.address.rpartition("/")[2])
        assert (status, headers["location"]) == (303, "/")
        assert "HttpOnly" in headers["set-cookie"]
        assert "SameSite=lax" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert str(port_of(server)) in cookie
        assert get(server, "/", Cookie=cookie)[0] == 200
        with Client(server, additional_headers={"Cookie": cookie}) as client:
            assert client.number == 1
