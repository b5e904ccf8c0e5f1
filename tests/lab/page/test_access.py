"""Who may talk to the server."""

import pytest
from starlette.datastructures import Headers
from websockets.exceptions import InvalidStatus

from flexneedle.lab.page.server import access
from flexneedle.lab.page.server.access import AccessRules
from page_clients import Client, get, port_of, served

HERE = AccessRules.of("127.0.0.1", 8000)


def refusal(gate, *, socket=True, page=False, query="", **headers):
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    return gate.refuse(Headers(raw=raw), query, socket=socket, page=page)


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8000", "localhost:8000", "localhost", "[::1]:8000", "LocalHost:9"]
)
def test_the_page_itself_may_connect(host):
    assert refusal(HERE, host=host, origin=f"http://{host}") is None


@pytest.mark.parametrize(
    "host",
    [
        *(
            "evil.example",
            "evil.example:8000",
            "127.0.0.1.evil.example",
            "localhost@evil.example",
            "10.0.0.1",
        ),
        *("", "[::2]", "localhost:8000:8000", "localhost/", "[", "127.0.0.1 ", "[::1"),
        *("[abc]", "[1.2.3]", "[127.0.0.1]", "[::1]x"),
    ],
)
def test_another_host_is_refused(host):
    status, reason = refusal(HERE, socket=False, host=host)
    assert status == 403
    assert reason.startswith("Host = ")
    assert reason.endswith("must be one of 127.0.0.1, ::1, localhost")


@pytest.mark.parametrize("site", ["cross-site", "same-site", "same-origin", "none"])
def test_another_site_may_link_to_the_page_and_to_nothing_else(site):
    asked = {"socket": False, "host": "127.0.0.1:8000", "sec_fetch_site": site}
    assert refusal(HERE, page=True, **asked) is None
    refused = refusal(HERE, **asked)
    if site == "cross-site":
        assert refused == (403, "Sec-Fetch-Site = cross-site: only the page itself may ask for this")
    else:
        assert refused is None


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://127.0.0.1",
        "http://127.0.0.1:8001",
        "http://localhost:8000",
        "null",
        "file://",
        "",
    ],
)
@pytest.mark.parametrize("socket", [True, False])
def test_another_origin_is_refused(origin, socket):
    status, reason = refusal(HERE, socket=socket, host="127.0.0.1:8000", origin=origin)
    assert status == 403
    assert "must be http://127.0.0.1:8000" in reason


def test_a_web_socket_needs_an_origin():
    assert refusal(HERE, host="127.0.0.1:8000") == (
        403,
        "Origin is missing: only the page itself may connect",
    )
    assert refusal(HERE, socket=False, host="127.0.0.1:8000") is None


def test_two_hosts_are_refused():
    headers = Headers(raw=[(b"host", b"127.0.0.1"), (b"host", b"127.0.0.1")])
    assert HERE.refuse(headers, "", socket=False) is not None


class TestAnotherAddress:
    gate = AccessRules.of("192.0.2.1", 8000)

    def asked(self, host="192.0.2.1:8000", query="", **headers):
        return refusal(self.gate, host=host, origin=f"http://{host}", query=query, **headers)

    def test_it_needs_a_token(self):
        assert self.asked()[0] == 401
        assert self.asked(query=f"token={self.gate.token}") is None
        assert self.asked(cookie=f"a=b; {self.gate.cookie}={self.gate.token}") is None

    @pytest.mark.parametrize("token", ["", "x", "σ"])
    def test_a_wrong_one_is_refused(self, token):
        assert self.asked(query=f"token={token}")[0] == 401
        assert self.asked(cookie=f"{self.gate.cookie}={token}")[0] == 401

    def test_tokens_differ(self):
        assert len(self.gate.token) >= 32
        assert AccessRules.of("192.0.2.1", 8000).token != self.gate.token

    def test_a_name_that_anybody_can_have_resolved_is_refused(self):
        query = f"token={self.gate.token}"
        assert self.asked("evil.example", query)[0] == 403
        assert self.asked("192.0.2.7", query) is None
        assert self.asked("[2001:db8::1]:8000", query) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.1.2.3"])
def test_the_computers_own_address_needs_no_token(host):
    assert AccessRules.of(host, 8000).token == ""


# Over sockets


@pytest.mark.parametrize("path", ["/", "/schema.json", "/scenario.toml", "/nonsense", "/static/nonsense.js"])
def test_every_answer_has_the_headers(shared_server, path):
    _status, _text, headers = get(shared_server, path)
    policy = headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self';" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}])
def test_a_foreign_request_is_refused_with_a_reason(shared_server, headers):
    status, text, answered = get(shared_server, "/", **headers)
    assert (status, text.split(" = ")[0]) == (403, next(iter(headers)))
    assert "default-src 'none'" in answered["content-security-policy"]


def test_another_site_may_link_to_the_page_but_not_to_its_files(shared_server):
    assert get(shared_server, "/", Sec_Fetch_Site="cross-site")[0] == 200
    status, text, _headers = get(shared_server, "/scenario.toml", Sec_Fetch_Site="cross-site")
    assert (status, text.split(" = ")[0]) == (403, "Sec-Fetch-Site")
    assert get(shared_server, "/scenario.toml", Sec_Fetch_Site="same-origin")[0] == 200


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"origin": None}, "Origin is missing"),
        ({"origin": "http://evil.example"}, "Origin = 'http://evil.example'"),
    ],
)
def test_a_foreign_web_socket_is_refused_with_a_reason(shared_server, options, reason):
    with pytest.raises(InvalidStatus) as refused:
        Client(shared_server, **options)
    assert refused.value.response.status_code == 403
    assert refused.value.response.body.decode().startswith(reason)


def test_the_token_is_in_the_printed_address_and_then_in_a_cookie(tmp_path, monkeypatch):
    monkeypatch.setattr(access, "is_loopback", lambda _host: False)
    with served(tmp_path) as server:
        assert get(server, "/")[0] == 401
        with pytest.raises(InvalidStatus):
            Client(server)
        path = "/" + server.address.rpartition("/")[2]
        status, _text, headers = get(server, path)
        assert (status, headers["location"]) == (303, "/")
        assert "HttpOnly" in headers["set-cookie"]
        assert "SameSite=lax" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert get(server, "/", Cookie=cookie)[0] == 200
        with Client(server, additional_headers={"Cookie": cookie}) as client:
            assert client.number == 1
        assert str(port_of(server)) in cookie
