-- A text inside a segment's header: two bytes of length, big-endian, then UTF-8.
create function header_text(p_text text) returns bytea language sql immutable strict as $$
  select substring(int4send(octet_length(convert_to(p_text, 'UTF8'))) from 3) || convert_to(p_text, 'UTF8')
$$;
