"""A station asks central: questions and answers within a session of their own.

Contract: a session begins with the first question and is begun anew, once, where central no longer knows it. A
question may be asked again at any time: it changes nothing at central but its record.
"""

from collections.abc import Callable

from sync.errors import SessionOver
from sync.protocol.questions import FIND, QUERY, Answer, FindQuestion, QueryQuestion
from sync.station.client import Central, Greeting


class Desk:
    """Central, as one who asks sees it.

    Args:
        central: Central, with what signs this station's requests.
        greeting: What the station says of itself when a session begins.
    """

    def __init__(self, central: Central, greeting: Callable[[], Greeting]) -> None:
        self._central = central
        self._greeting = greeting
        self._is_known = False

    def find(self, question: FindQuestion) -> Answer:
        """One page of what central finds.

        Raises:
            CentralError: There is no answer.
        """
        return self._asked(FIND, question)

    def query(self, question: QueryQuestion) -> Answer:
        """Central's answer to SQL.

        Raises:
            CentralError: There is no answer.
        """
        return self._asked(QUERY, question)

    def _asked(self, endpoint: str, question: FindQuestion | QueryQuestion) -> Answer:
        if self._is_known:
            try:
                return self._central.ask(endpoint, question, Answer)
            except SessionOver:
                self._is_known = False
        self._central.hello(self._greeting())
        self._is_known = True
        return self._central.ask(endpoint, question, Answer)
